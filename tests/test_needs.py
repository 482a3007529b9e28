"""A missing program fails in CI and is a named reason to skip elsewhere."""

import pytest
from needs import need_program


def test_what_is_missing_fails_in_ci_and_is_skipped_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="nothing-like-it is not installed: apt install it"):
        need_program("nothing-like-it", package="it")
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="nothing-like-it is not installed: apt install it"):
        need_program("nothing-like-it", package="it")
    assert need_program("nothing-like-it", "sh", package="it").endswith("sh")
