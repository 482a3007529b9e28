"""Helpers shared by the command-line entry points."""

import argparse
import bdb
import contextlib
import difflib
import errno
import io
import os
import re
import shlex
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from msk_ray import signals
from msk_ray.errors import MskRayError, StorageFailure, brief, shortened
from msk_ray.text import printable

TERMINAL_LOG = "terminal.log"
"""File in a run's folder that receives the output once the terminal is closed."""
_UNREAD = (errno.EPIPE, errno.EIO)
"""Errors from a pipe whose reader has exited, and from a closed terminal."""
_ADVICE = {
    errno.ENAMETOOLONG: "too long for a file name; write a shorter one",
    errno.EACCES: "permission denied; name another file or folder, or ask its owner",
}
"""What a user can do about common file errors of the operating system."""


class Command(NamedTuple):
    """A command of `msk-ray`. Another package declares one in the entry-point group `msk_ray.commands`."""

    module: str
    """The module whose `main(argv)` runs it and returns the exit code."""
    summary: str
    """What it does, on one line."""


STORAGE: dict[str, Any] = {
    "type": Path,
    "default": Path("runs"),
    "metavar": "DIR",
    "help": "folder of experiments (default: runs/)",
}
"""Of the option `--storage`, which many commands have."""


def positive(text: str) -> int:
    """A whole number of at least 1, within the range of Warp and CUDA."""
    if not text.isdecimal() or not 1 <= int(text) < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1 and below 2^31, not {text}")
    return int(text)


def port_number(text: str) -> int:
    """A port to listen on; 0: any free one."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, not {text}")
    return int(text)


def geom_group_list(text: str) -> tuple[int, ...]:
    """Groups of MuJoCo's geoms, such as 0,3."""
    if re.fullmatch(r"[0-5](,[0-5])*", text) is None:
        raise argparse.ArgumentTypeError(f"write numbers from 0 to 5, such as 0,3, not {text}")
    return tuple(sorted({int(group) for group in text.split(",")}))


def seconds(text: str) -> float:
    """An interval of an option, at least 0.1 [s]."""
    value = float(text)
    if not 0.1 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"at least 0.1, not {text}")
    return value


seconds.__name__ = "number"  # argparse names it where the text is none


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps line breaks in its description and examples."""

    def __init__(self, prog: str, description: str, examples: str) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=f"examples:\n{examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self._words: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self._words = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the error on one line that is safe for a terminal, and exit with 2."""
        # Report unknown options first; argparse would report what is missing because of them.
        heads = [word.partition("=")[0] for word in self._words if word.startswith("--") and word != "--"]
        options = [option for option in self._option_string_actions if option.startswith("--")]
        for head in heads:
            if not any(option.startswith(head) for option in options):
                near = difflib.get_close_matches(head, options, n=1)
                message = f"no option {shortened(head)}" + (f"; did you mean {near[0]}?" if near else "")
                break
        self.exit(2, f"error: {printable(message)} (all options: {self.prog} --help)\n")


def typed_command(argv: Sequence[str], *more: str) -> str:
    """The command line to type for `argv`, plus those options of `more` that it lacks."""
    program = Path(argv[0])
    # For `python -m msk_ray.tune`, argv[0] is the path of a file.
    module = _module_of(program)
    if module is None and program.name == "__main__.py":
        module = program.parent.name
    if module is not None:
        words = ["python", "-m", module]
    else:
        words = ["python", program.name] if program.suffix == ".py" else [program.name]
    return shell_join([*words, *argv[1:], *(option for option in more if option not in argv)])


def shell_join(words: Sequence[str]) -> str:
    """Words quoted for a shell, with invisible characters escaped."""
    return " ".join(_quoted(word) for word in words)


def option_value(words: Sequence[str], option: str) -> str | None:
    """The value of a long option in the words of a command line, also if abbreviated; the last one counts."""
    value = None
    for place, word in enumerate(words):
        head, separator, attached = word.partition("=")
        if _means(head, option):
            value = attached if separator else next(iter(words[place + 1 :]), None)
    return value


def with_option(words: Sequence[str], option: str, value: str) -> list[str]:
    """The words of a command line with a long option's value replaced, or the option appended."""
    changed, rest, place = [], iter(words), None
    for word in rest:
        head, separator, _ = word.partition("=")
        if not _means(head, option):
            changed.append(word)
            continue
        place = len(changed) if place is None else place
        if not separator:
            next(rest, None)
    place = len(changed) if place is None else place
    return [*changed[:place], option, value, *changed[place:]]


def _means(word: str, option: str) -> bool:
    """Whether a word is an option, or an abbreviation that argparse accepts for it."""
    return len(word) > len("--x") and option.startswith(word)


def _quoted(word: str) -> str:
    r"""A word quoted for a shell. Invisible characters are escaped as in bash and zsh: `$'a\x1bb'`."""
    if word.isprintable():
        return shlex.quote(word)
    return f"$'{''.join(_escaped(character) for character in word)}'"


def _escaped(character: str) -> str:
    """A character, escaped for use between `$'` and `'`."""
    if character.isprintable() and character not in "'\\":
        return character
    # Python represents a byte that is not UTF-8 as a lone surrogate.
    kept = "surrogateescape" if "\udc80" <= character <= "\udcff" else "surrogatepass"
    return "".join(f"\\x{byte:02x}" for byte in character.encode(errors=kept))


def _module_of(program: Path) -> str | None:
    """The name of the package's module in a file, of this checkout or another one; None if it is not one.

    Found by comparing with this package's files, because any folder in the path may be called msk_ray too.
    """
    package = Path(__file__).resolve().parent
    for place, part in enumerate(program.parts):
        inside = Path(*program.parts[place + 1 :])
        if part == package.name and inside.suffix == ".py" and (package / inside).is_file():
            names = inside.with_suffix("").parts
            return ".".join([package.name, *(names[:-1] if names[-1] == "__main__" else names)])
    return None


_at_once = False


def end_at_once() -> None:
    """Let `run` end this process without the interpreter's shutdown, because something would wait there forever."""
    global _at_once
    _at_once = True


def run(main: Callable[[Sequence[str] | None], int], argv: Sequence[str] | None = None) -> int:
    """Run an entry point. Errors that the user can fix become one line on stderr and a non-zero exit code.

    If the program listens to `signals`, and `main` had nothing to save on a request to stop, the exit code is 75.
    """
    code = 1
    try:
        code = _run(main, argv)
        return code
    except Exception:
        if _at_once:
            traceback.print_exc()
        raise
    finally:
        if _at_once:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError, ValueError):  # nobody reads the output
                    stream.flush()
            os._exit(code)


def _run(main: Callable[[Sequence[str] | None], int], argv: Sequence[str] | None) -> int:
    # Unlike `python -m`, console scripts do not search the current folder, but a class named in a configuration must be
    # found either way.
    if "" not in sys.path:
        sys.path.append("")
    stop = signals.current()
    try:
        if stop is not None:
            stop.loading = False
        return main(argv)
    except MskRayError as error:
        print(f"error: {printable(str(error))}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        if stop is not None and stop.signal is not None and not stop.insisted:
            print(f"stopped by {stop.signal.name}", file=sys.stderr)
            return signals.RESUMABLE
        print("interrupted", file=sys.stderr)
        return 130
    except bdb.BdbQuit:
        print("quit at a breakpoint", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output, such as `head`, has exited.
        sys.stderr.close()
        return 0
    except OSError as error:
        if error.errno not in _ADVICE or error.filename is None:
            raise
        print(f"error: {printable(brief(error.filename))}: {_ADVICE[error.errno]}", file=sys.stderr)
        return MskRayError.exit_code
    finally:
        if stop is not None:
            stop.settle()


class _RedirectableStream(io.TextIOBase):
    """An unbuffered standard stream that continues in a file once its reader has gone."""

    def __init__(self, descriptor: int, log: Path, descriptors: Sequence[int]) -> None:
        self._descriptor = descriptor
        self._log = log
        self._descriptors = descriptors

    def write(self, text: str) -> int:
        data = text.encode("utf-8", errors="replace")
        while data:
            try:
                data = data[os.write(self._descriptor, data) :]
            except OSError as error:
                if error.errno not in _UNREAD:
                    raise
                self._move(error)
        return len(text)

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def _move(self, error: OSError) -> None:
        """Redirect this stream to the file, and also the other one if it is the same pipe or terminal."""
        try:
            file = os.open(self._log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as fault:
            raise StorageFailure(f"cannot write {self._log}: {fault.strerror}") from fault
        when = time.strftime("%Y-%m-%d %H:%M:%S")
        os.write(file, f"--- {when}: nobody reads the output any more ({error.strerror}); it continues here\n".encode())
        lost = os.fstat(self._descriptor)
        for descriptor in self._descriptors:
            if os.path.samestat(os.fstat(descriptor), lost):
                os.dup2(file, descriptor)
        os.close(file)


@contextlib.contextmanager
def surviving_closed_output(log: Path) -> Iterator[None]:
    """Context in which a program continues when its output's reader has gone: output then goes to a file.

    Standard output and error stay redirected afterwards, for child processes and Python's shutdown.

    Args:
        log: the file; created only when it is needed.

    Raises:
        StorageFailure: inside the block, if the file cannot be written.
    """
    descriptors = [_descriptor(stream) for stream in (sys.stdout, sys.stderr)]
    known = [descriptor for descriptor in descriptors if descriptor is not None]
    out, err = (
        None if descriptor is None else _RedirectableStream(descriptor, log, known) for descriptor in descriptors
    )
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    with contextlib.redirect_stdout(out or sys.stdout), contextlib.redirect_stderr(err or sys.stderr):
        yield


def _descriptor(stream: object) -> int | None:
    """The file descriptor of a standard stream; None if it has none, for example under a test runner, or if it was
    closed from the start."""
    if stream is None:
        return None
    try:
        descriptor: int = stream.fileno()  # type: ignore[attr-defined]
    except io.UnsupportedOperation:
        return None
    return descriptor
