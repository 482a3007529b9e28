"""Commands as one would type them again."""

import pytest

from msk_ray.cli import typed_command


@pytest.mark.parametrize(
    ("argv", "command"),
    [
        (["/x/msk_ray/tune/__main__.py", "--space", "a b"], "python -m msk_ray.tune --space 'a b' --resume"),
        (["/x/msk_ray/train.py", "--set", "a=1", "--resume"], "python -m msk_ray.train --set a=1 --resume"),
        (["/x/bin/msk-ray", "tune"], "msk-ray tune --resume"),
        (["/x/own.py"], "python own.py --resume"),
    ],
)
def test_the_command_that_goes_on(argv: list[str], command: str) -> None:
    assert typed_command(argv, "--resume") == command
