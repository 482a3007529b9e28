"""Where the tests' temporary files lie."""

import subprocess
import sys
import tempfile
from pathlib import Path


def test_libraries_and_programs_put_their_files_below_one_folder(temporary_files: Path) -> None:
    """Which is not that of the machine, where they would stay."""
    assert Path(tempfile.gettempdir()) == temporary_files
    code = "import tempfile; print(tempfile.gettempdir())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told == f"{temporary_files}\n"
    sockets = "ray/session_2026-11-22_22-30-00_123456_1234567/sockets/plasma_store"
    assert len(str(temporary_files / "msk-12345678" / sockets)) < 107
