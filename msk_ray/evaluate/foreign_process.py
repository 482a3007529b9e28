"""The process of another Python in which a package's environment runs, spoken to through its standard streams."""

import json
import subprocess
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from msk_ray.errors import ConfigError, SimulationError
from msk_ray.evaluate.elsewhere import ForeignScoring


class ForeignProcess(AbstractContextManager["ForeignProcess"]):
    """A script that greets with one line of JSON, then reads actions and answers with records.

    It is ended on exit, if it has not ended by itself.

    Args:
        scoring: of the package.
        python: the interpreter.
        script: path of the script.
        asked: what it is asked for, its only argument.

    Attributes:
        hello: what it greeted with.
        versions: of the packages there, a part of that.

    Raises:
        ConfigError: it ended before it had greeted, or the package has another version.
    """

    def __init__(self, scoring: ForeignScoring, python: Path, script: str, asked: dict[str, Any]) -> None:
        self._name = scoring.name
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115  # closed on exit
        self._process = subprocess.Popen(
            # Isolated: beside the script may lie a module called like the package, and PYTHONPATH is meant for our
            # versions.
            [str(python), "-I", script, json.dumps(asked)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._messages,
        )
        try:
            line = self._out.readline()
            if not line:
                raise ConfigError(f"--in {self._name}: {self._last_words()}; {scoring.install}")
            self.hello: dict[str, Any] = json.loads(line)
            self.versions: dict[str, str] = self.hello["versions"]
            found = self.versions[scoring.name]
            if not found.startswith(f"{scoring.version}."):
                raise ConfigError(
                    f"--in {scoring.name}: {scoring.package} {found} has other tasks than {scoring.version}.x; "
                    f"{scoring.install}"
                )
        except BaseException:
            self.__exit__(None, None, None)
            raise

    @property
    def _out(self) -> IO[bytes]:
        assert self._process.stdout is not None
        return self._process.stdout

    def write(self, actions: NDArray[np.floating]) -> None:
        """Send actions, as float32.

        Raises:
            SimulationError: it has ended.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(actions.astype("<f4").tobytes())
            self._process.stdin.flush()
        except BrokenPipeError:
            raise SimulationError(f"--in {self._name}: {self._last_words()}") from None

    def read(self, record: np.dtype, count: int) -> np.ndarray:
        """The next `count` records, (count, ...).

        Raises:
            SimulationError: it has ended.
        """
        size = count * record.itemsize
        data = self._out.read(size)
        if len(data) < size:
            raise SimulationError(f"--in {self._name}: {self._last_words()}")
        base, shape = record.subdtype or (record, ())
        return np.frombuffer(bytearray(data), base).reshape(-1, *shape)

    def _last_words(self) -> str:
        """The last line that the process wrote before it ended."""
        self._process.wait()
        self._messages.seek(0)
        lines = self._messages.read().decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return said[-1] if said else f"it ended with exit code {self._process.returncode}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()
        self._messages.close()
