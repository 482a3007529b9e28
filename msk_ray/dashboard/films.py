"""Films of the best policies so far, made in the background, one at a time, by `python -m msk_ray.visualize`."""

import os
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from msk_ray.errors import MskRayError
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.snapshot import file_stamp
from msk_ray.files import make_folder

FOLDER = "report"
"""Subfolder of an experiment that also holds its report."""
PREFIX = "film_"
_SIZE, _FPS = "480x360", "25"


@dataclass(frozen=True)
class Film:
    """A film of a policy, or why there is none."""

    link: str
    """Path relative to the experiment; empty if there is no film."""
    words: str
    """What it shows, or why there is none."""


class Films:
    """Makes films of checkpoints. A film is removed once there is one of a newer checkpoint."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._wanted: dict[tuple[Path, str], tuple[Path, Path]] = {}
        self._failed: dict[Path, str] = {}
        self._process: subprocess.Popen[str] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="films", daemon=True)
        self._thread.start()

    def of(self, experiment: Experiment, part: str, checkpoint: Path) -> Film:
        """The film of a checkpoint; while it is being made, the film of an earlier one.

        Args:
            part: the environment, if the experiment has several.
        """
        stamp = file_stamp(checkpoint)
        if stamp is None:
            return Film("", "There is no film: the checkpoint is missing.")
        kind = "".join(c if c.isalnum() else "-" for c in part) or "best"
        folder = experiment.path / FOLDER
        film = folder / f"{PREFIX}{kind}_{stamp[0]:x}.mp4"
        if film.is_file():
            return Film(f"{FOLDER}/{film.name}", "An episode of the best policy so far.")
        earlier = next(folder.glob(f"{PREFIX}{kind}_*.mp4"), None)
        link = "" if earlier is None else f"{FOLDER}/{earlier.name}"
        with self._condition:
            if film in self._failed:
                words = f"There is no film of the best policy: {self._failed[film]}"
                return Film(link, f"{words}; this is an earlier one." if link else words)
            self._wanted[experiment.path, kind] = (checkpoint, film)
            self._condition.notify()
        words = "A film of the best policy is being made"
        return Film(link, f"{words}; this is an earlier one." if link else f"{words}.")

    def close(self) -> None:
        """End the running process, if there is one."""
        with self._condition:
            self._closed = True
            self._wanted.clear()
            self._condition.notify()
            if self._process is not None:
                self._process.terminate()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closed or self._wanted)
                if self._closed:
                    return
                wish = next(iter(self._wanted))
                checkpoint, film = self._wanted[wish]
            why = self._make(checkpoint, film)
            with self._condition:
                if why is not None:
                    self._failed[film] = why
                # Meanwhile, a film of a newer checkpoint may have been requested.
                if self._wanted.get(wish) == (checkpoint, film):
                    del self._wanted[wish]

    def _make(self, checkpoint: Path, film: Path) -> str | None:
        """Make a film. Returns why that failed, on one line, or None."""
        # ".part" before the suffix, which names the format.
        part = film.with_name(f".{film.stem}.{os.getpid()}.part.mp4")
        try:
            make_folder(film.parent)
        except MskRayError as error:
            return str(error)
        # GPUs are for the trials.
        environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
        with self._condition:
            if self._closed:
                return None
            self._process = subprocess.Popen(
                ["nice", "-n", "10", *command_for(checkpoint, part)],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        errors = self._process.communicate()[1].strip().splitlines()
        code = self._process.returncode
        with self._condition:
            self._process = None
        try:
            if code or not part.is_file():
                return errors[-1].removeprefix("error: ") if errors else f"exit code {code}"
            part.replace(film)
            for old in film.parent.glob(f"{film.stem.rpartition('_')[0]}_*.mp4"):
                if old != film:
                    old.unlink(missing_ok=True)
        except OSError as error:
            return f"cannot write {film}: {error.strerror or error}"
        finally:
            part.unlink(missing_ok=True)
        return None


def command_for(checkpoint: Path, film: Path) -> list[str]:
    """The command that makes a film."""
    words = ["-m", "msk_ray.visualize", str(checkpoint), "--video", str(film), "--size", _SIZE, "--fps", _FPS]
    return [sys.executable, *words, "--device", "cpu"]
