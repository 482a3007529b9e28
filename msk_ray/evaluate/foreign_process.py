"""A process of another Python that runs another package's environment, and exchanges bytes through standard streams."""

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
from msk_ray.evaluate.foreign_scoring import ForeignScoring


class ForeignProcess(AbstractContextManager["ForeignProcess"]):
    """A process that first writes one line of JSON, then reads actions and answers with records.

    On exit it is killed if it is still running.

    Args:
        scoring: the package.
        python: the interpreter.
        script: path of the script that the process runs.
        order: what to run; the script's only argument, as JSON.

    Attributes:
        hello: content of the first line.
        versions: versions of the packages there, from the first line.

    Raises:
        ConfigError: the process ended before its first line, or the package has another version.
    """

    def __init__(self, scoring: ForeignScoring, python: Path, script: str, order: dict[str, Any]) -> None:
        self._name = scoring.name
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115  # closed on exit
        self._process = subprocess.Popen(
            # Isolated: beside the script may lie a module called like the package, and PYTHONPATH is meant for our
            # versions.
            [str(python), "-I", script, json.dumps(order)],
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
            version = self.versions[scoring.name]
            if not version.startswith(f"{scoring.version}."):
                raise ConfigError(
                    f"--in {scoring.name}: {scoring.package} {version} has other tasks than {scoring.version}.x; "
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
        """Send actions as float32.

        Raises:
            SimulationError: the process has ended.
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
            SimulationError: the process has ended.
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
        messages = [line.strip() for line in lines if line.strip()]
        return messages[-1] if messages else f"it ended with exit code {self._process.returncode}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()
        self._messages.close()
