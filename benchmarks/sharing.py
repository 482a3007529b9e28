"""How many env steps per second trials make that share one GPU, by their number, with and without Nvidia's MPS.

    python benchmarks/sharing.py --config configs/ant_hard.yaml --worlds 2048 --trials 1 2 4
    nvidia-cuda-mps-control -d; python benchmarks/sharing.py ...; echo quit | nvidia-cuda-mps-control

Each trial is a process of `msk_ray.train`. Counted are the env steps of all of them from the moment the last one has
its warm-up behind it to the moment the first one ends. Whether MPS runs is asked of its control program.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from record import RESULTS, markdown_table, publish

from msk_ray.experiment.layout import METRICS_FILE
from msk_ray.experiment.metrics import read_rows

WARM_UP = 6
"""Epochs of a trial that are not counted: kernels are loaded and recorded in them."""
POLL = 0.1
"""Between looks at how far trials are [s]."""


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, default=2048)
    p.add_argument("--trials", type=int, nargs="+", default=[1, 2, 4])
    p.add_argument("--epochs", type=int, default=60, help=f"of each trial; the first {WARM_UP} are not counted")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--device", default="cuda:0")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    shared = "MPS" if mps_runs() else "time slices"
    rows, alone = [], 0.0
    for trials in args.trials:
        rate = together(trials, args)
        alone = alone or rate / trials
        rows.append([f"{trials}", shared, f"{rate:,.0f}", f"{rate / alone:.2f}"])
        print(rows[-1], flush=True)
    header = ["trials", "GPU shared by", "env steps/s, all together", f"times that of {args.trials[0]}"]
    title = f"Trials that share a GPU, {args.config.stem}, {args.worlds} worlds each"
    publish("sharing", title, args.device, markdown_table(header, rows), args.results)


def mps_runs() -> bool:
    """Whether a control daemon of MPS answers."""
    program = shutil.which("nvidia-cuda-mps-control")
    if program is None:
        return False
    return subprocess.run([program], input="get_server_list\n", text=True, capture_output=True).returncode == 0


def together(trials: int, args: argparse.Namespace) -> float:
    """Env steps per second of so many trials at once."""
    rare = ["evaluation.nworld=1", "evaluation.steps=1", f"evaluation.interval={args.epochs}", "trial.loggers=[]"]
    settings = [*rare, f"trial.epochs={args.epochs}", f"env.nworld={args.worlds}", *args.overrides]
    sets = [word for setting in settings for word in ("--set", setting)]
    with tempfile.TemporaryDirectory() as name:
        folders = [Path(name) / f"{seed}" for seed in range(trials)]
        command = [sys.executable, "-m", "msk_ray.train", "--config", str(args.config), "--device", args.device]
        running = []
        for seed, folder in enumerate(folders):
            # A file, because a pipe that nobody reads would fill up and stop the trial.
            with (Path(name) / f"{seed}.log").open("w") as log:
                own = [*command, "--seed", f"{seed}", "--logdir", str(folder), *sets]
                running.append(subprocess.Popen(own, stdout=log, stderr=subprocess.STDOUT))
        try:
            rate = counted(running, folders, args.epochs)
        except RuntimeError as error:
            log = "\n".join(path.read_text() for path in Path(name).glob("*.log"))
            raise SystemExit(f"{error}:\n{log}") from None
        finally:
            for process in running:
                process.terminate()
                process.wait()
    return rate


def counted(running: list[subprocess.Popen[bytes]], folders: list[Path], epochs: int) -> float:
    """Env steps per second of all, while all train."""
    marks: list[tuple[float, float]] = []
    while len(marks) < 2:
        time.sleep(POLL)
        if any(process.poll() not in (None, 0) for process in running):
            raise RuntimeError("a trial failed")
        rows = [read_rows(folder)[-1] if (folder / METRICS_FILE).exists() else {"epoch": 0} for folder in folders]
        done = [row["epoch"] for row in rows]
        if (not marks and min(done) > WARM_UP) or (marks and max(done) == epochs):
            marks.append((time.perf_counter(), sum(row["env_steps"] for row in rows)))
        elif not marks and max(done) == epochs:
            raise RuntimeError("the first trial ended before the last was warm: give more --epochs")
    (begin, before), (end, after) = marks
    return (after - before) / (end - begin)


if __name__ == "__main__":
    main()
