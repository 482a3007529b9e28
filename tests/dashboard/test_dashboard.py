"""The live page: what it serves to whom, and that it follows an experiment in a real browser."""

import http.client
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from needs import slow
from processes import Launcher, wait_until
from serving import Server, fill, make

from msk_ray.cli import run
from msk_ray.dashboard import films, plots
from msk_ray.dashboard.__main__ import main
from msk_ray.dashboard.films import Films
from msk_ray.dashboard.guard import Access
from msk_ray.dashboard.library import Library, Unknown
from msk_ray.errors import ConfigError
from msk_ray.experiment import snapshot
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.notes import load_notes
from msk_ray.report.reading import read_experiment


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return make(tmp_path / "runs", "e")


@pytest.fixture
def served(experiment: Experiment) -> Iterator[Server]:
    server = Server(Library(experiment.path.parent, 0.2, True, None), Access(True, (), True))
    yield server
    server.close()


def test_only_those_who_mean_this_server_are_answered() -> None:
    local, network = Access(True, ("desk.example",), True), Access(False, (), False)
    for host in ("127.0.0.1", "127.0.0.1:8321", "localhost:1", "LOCALHOST", "[::1]:8321", "desk.example:80"):
        assert local.knows(host), host
    for host in ("", "evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8321", "10.0.0.1", "[fe80::1]"):
        assert not local.knows(host), host
    assert network.knows("10.0.0.1:8321")
    assert not network.knows("evil.example:8321")


def test_requests_from_elsewhere_are_refused(served: Server, experiment: Experiment) -> None:
    trial = experiment.trials()[0].id
    note, body = f"/e/e/trials/{trial}/note", json.dumps({"text": "mine"})
    own, kind = f"http://127.0.0.1:{served.port}", "application/json"
    assert served.ask("/e/e/", Host="evil.example")[0] == 421
    for status, headers in (
        (403, {"Content_Type": kind}),
        (403, {"Content_Type": kind, "Origin": "http://evil.example"}),
        (403, {"Content_Type": kind, "Origin": "null"}),
        (415, {"Content_Type": "text/plain", "Origin": own}),
        (421, {"Content_Type": kind, "Origin": "http://evil.example", "Host": "evil.example"}),
    ):
        assert served.ask(note, "POST", body, **headers)[0] == status, headers
    assert served.ask(note, "POST", "[1]", Content_Type=kind, Origin=own)[0] == 400
    assert served.ask("/e/e/trials/none/note", "POST", body, Content_Type=kind, Origin=own)[0] == 404
    assert load_notes(experiment.path) == {}
    assert served.ask(note, "POST", body, Content_Type=kind, Origin=own)[0] == 200
    assert load_notes(experiment.path) == {trial: "mine"}
    status, page, headers = served.ask("/e/e/")
    assert (status, "mine</textarea>" in page, "Which &lt;i&gt;rate&lt;/i&gt;?" in page) == (200, True, True)
    assert "script-src 'self';" in headers["Content-Security-Policy"]


def test_a_read_only_dashboard_takes_no_notes(experiment: Experiment) -> None:
    server = Server(Library(experiment.path.parent, 0.2, False, None), Access(False, (), False))
    try:
        own = f"http://127.0.0.1:{server.port}"
        note = f"/e/e/trials/{experiment.trials()[0].id}/note"
        answer = server.ask(note, "POST", '{"text": "x"}', Content_Type="application/json", Origin=own)
        assert answer[:2] == (403, "read-only: start it with --allow-notes\n")
        assert "<textarea" not in server.ask("/e/e/")[1]
    finally:
        server.close()


def test_names_never_become_paths(served: Server, experiment: Experiment) -> None:
    trial = experiment.trials()[0].id
    (experiment.path.parent / "secret.txt").write_text("secret")
    status, text, headers = served.ask(f"/e/e/trials/{trial}/metrics.jsonl")
    assert (status, headers["Content-Type"]) == (200, "text/plain; charset=utf-8")
    assert '"epoch"' in text
    for path in (
        "/e/..%2Fruns/",
        "/e/%2e%2e/",
        "/e/e%2F..%2Fe/",
        "/e/secret.txt/",
        "/e/e/trials/../manifest.json",
        f"/e/e/trials/{trial}/../../manifest.json",
        f"/e/e/trials/{trial}/..%2F..%2Fmanifest.json",
        f"/e/e/trials/..%2Ftrials%2F{trial}/metrics.jsonl",
        f"/e/e/trials/{trial}/checkpoints/best.pt",
        "/e/e/report/..%2Fmanifest.json",
        "/e/e/report/film_x.mp4",
        "/static/..%2Fpage.py",
        "/e/none/",
        "/e/e/?with=none",
    ):
        status, text, _ = served.ask(path)
        assert status == 404, (path, status)
        assert "secret" not in text or path == "/e/secret.txt/"


def test_what_has_not_changed_is_neither_read_nor_drawn_again(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library(experiment.path.parent, 1e-3, True, None)

    def look() -> Any:
        for kept in library._pages.values():
            kept.due = 0.0
        return library.page(["e"])

    first = look()
    read: list[Path] = []
    load = snapshot.load_metrics
    monkeypatch.setattr(snapshot, "load_metrics", lambda path: read.append(path) or load(path))
    assert look() is first
    assert read == []
    running = experiment.trial_folder(experiment.trials()[3].id)
    fill(running, [1.0, 13.0, 77.5], ended=False)
    second = look()
    assert second.version != first.version
    assert (read, "77.5" in second.html, "77.5" in first.html) == ([running / "metrics.jsonl"], True, False)
    # Between two looks, nobody reads anything.
    fill(running, [1.0, 13.0, 88.5], ended=False)
    library._pages["e",].due = float("inf")
    assert library.page(["e"]) is second
    with pytest.raises(Unknown):
        library.page(["none"])


@pytest.fixture(params=[1280, 375], ids=["wide", "narrow"])
def page(served: Server, browser: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": request.param, "height": 800})
    opened = context.new_page()
    complaints: list[str] = []
    opened.on("console", lambda message: complaints.append(message.text))
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    # A look at the version ends with the page that asked.
    ended = "net::ERR_ABORTED"
    opened.on("requestfailed", lambda failed: failed.failure == ended or complaints.append(failed.url))
    yield opened
    assert complaints == []
    context.close()


def test_a_page_follows_its_experiment(page: Any, served: Server, experiment: Experiment) -> None:
    trials = experiment.trials()
    page.goto(f"http://127.0.0.1:{served.port}/e/e/")
    fits = "document.documentElement.scrollWidth <= innerWidth"
    assert page.evaluate(fits)
    assert page.locator("figure[data-figure]").count() == 5
    chart = page.locator("[data-figure=curves] .chart")
    chart.focus()
    page.keyboard.press("+")
    page.fill("#words", trials[3].id)
    first, last = (page.get_by_label(f"Note on {trial.id}") for trial in (trials[0], trials[3]))
    last.fill("not ready")
    fill(experiment.trial_folder(trials[3].id), [1.0, 13.0, 77.5], ended=False)
    wait_until(lambda: "77.5" in page.locator("#content").text_content())
    # What the reader was doing is as it was.
    assert last.input_value() == "not ready"
    assert page.evaluate("document.activeElement.value") == "not ready"
    assert page.locator("#shown").text_content() == "1 of 4"
    ends = "box => page.chart(box).getOption().dataZoom[0]"
    assert [chart.evaluate(ends)[key] for key in ("start", "end")] == [25, 75]
    assert load_notes(experiment.path) == {}
    last.fill("look at <b>this</b>")
    page.keyboard.press("Tab")
    wait_until(lambda: load_notes(experiment.path))
    assert load_notes(experiment.path) == {trials[3].id: "look at <b>this</b>"}
    page.click("#filter button")
    assert first.is_visible()
    assert page.evaluate(fits)


def test_single_trials_are_listed(served: Server, experiment: Experiment) -> None:
    folder = experiment.path.parent / "train" / "mine"
    fill(folder, [1.0, 13.0], ended=False)
    (folder / "config.yaml").write_text("env: {name: cartpole}\ntrial: {epochs: 8}\n")
    status, page, _ = served.ask("/")
    row = page.partition("Single trials")[2]
    assert status == 200
    assert all(part in row for part in (">train/mine<", ">cartpole<", ">1/8<", ">13<"))
    assert served.ask("/e/train/")[0] == 404


def test_experiments_are_listed_and_compared(page: Any, served: Server, experiment: Experiment) -> None:
    make(experiment.path.parent, "f g")
    page.goto(f"http://127.0.0.1:{served.port}/")
    assert sorted(page.locator("tbody th").all_text_contents()) == ["e", "f g"]
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for name in ("f g", "e"):
        page.get_by_label(f"compare {name}").check()
    page.keyboard.press("Tab")
    page.get_by_role("button").press("Enter")
    page.wait_for_url("**/e/*/?with=*")
    assert page.locator("#figure-together .chart canvas").count() == 1
    assert page.locator("tr[data-trial]").count() == 8
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    links = page.evaluate("[...document.querySelectorAll('td.files a')].map(a => a.getAttribute('href'))")
    assert {link.split("/")[0] for link in links} == {"trials", ".."}
    statuses = page.evaluate("links => Promise.all(links.map(async (l) => (await fetch(l)).status))", links)
    assert set(statuses) == {200}


@pytest.mark.parametrize("page", [375, *slow(1280)], indirect=True)
def test_optunas_plots_are_drawn_or_what_is_missing_is_said(
    page: Any, served: Server, experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    page.goto(f"http://127.0.0.1:{served.port}/e/e/plots")
    titles = ["History", "Importances", "Contour of the two most important", "Slices"]
    assert page.locator("h2").all_text_contents() == titles
    wait_until(lambda: page.locator(".plot .main-svg").count() >= 4)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    reading = read_experiment(experiment, 0.0)
    study, names = plots._study(reading)
    assert (names, study.best_value) == (["shac.actor_lr", "shac.horizon"], 13.0)
    assert study.best_params["shac.horizon"] == experiment.trials()[3].changed["shac.horizon"]
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(ConfigError, match=r"pip install 'msk-ray\[dashboard\]'"):
        plots.figures(reading)


def test_a_film_is_made_once_for_each_checkpoint(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = experiment.path / "best.pt"
    checkpoint.write_bytes(b"policy")
    code = "import sys; open(sys.argv[2], 'wb').write(open(sys.argv[1], 'rb').read())"
    monkeypatch.setattr(films, "command_for", lambda source, out: [sys.executable, "-c", code, str(source), str(out)])
    maker = Films()
    try:

        def look() -> films.Film:
            return maker.of(experiment, "", checkpoint)

        assert look() == films.Film("", "A film of the best policy is being made.")
        wait_until(lambda: "so far" in look().words)
        first = experiment.path / look().link
        assert first.read_bytes() == b"policy"
        checkpoint.write_bytes(b"better")
        # Until the new one is there, the old one is shown, and called so.
        meanwhile = look()
        assert (meanwhile.link, "earlier" in meanwhile.words) == (f"report/{first.name}", True)
        wait_until(lambda: "so far" in look().words)
        second = experiment.path / look().link
        wait_until(lambda: list(second.parent.iterdir()) == [second])
        failing = [sys.executable, "-c", "import sys; sys.exit('error: no such thing')"]
        monkeypatch.setattr(films, "command_for", lambda source, out: failing)
        checkpoint.write_bytes(b"worse!")
        wait_until(lambda: "being made" not in look().words)
        assert look().words == "There is no film of the best policy: no such thing; this is an earlier one."
    finally:
        maker.close()


def test_closing_ends_a_film_at_work(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = experiment.path / "best.pt"
    checkpoint.write_bytes(b"policy")
    monkeypatch.setattr(films, "command_for", lambda *_: [sys.executable, "-c", "import time; time.sleep(600)"])
    maker = Films()
    maker.of(experiment, "", checkpoint)
    wait_until(lambda: maker._process is not None)
    process = maker._process
    assert process is not None
    maker.close()
    assert process.poll() is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "no folder nowhere"),
        (["runs/e"], "is an experiment: give the folder above it"),
        (["runs", "--host", "desk"], "write an address of this machine"),
        (["runs", "--allow-notes"], "leave it out"),
    ],
)
def test_bad_input_is_one_line(
    experiment: Experiment,
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(experiment.path.parents[1])
    assert run(main, [*arguments, "--no-films"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.long
def test_it_serves_until_it_is_asked_to_stop(experiment: Experiment, launcher: Launcher, tmp_path: Path) -> None:
    out = tmp_path / "out.txt"
    command = [sys.executable, "-m", "msk_ray.dashboard", str(experiment.path.parent), "--port", "0", "--no-films"]
    with out.open("w") as file:
        process = launcher.start(command, stdout=file)
    wait_until(lambda: "http://" in out.read_text() or process.poll() is not None)
    port = int(out.read_text().split("http://127.0.0.1:")[1].split("/")[0])
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    second = subprocess.run([*command[:4], "--port", str(port), "--no-films"], capture_output=True, text=True)
    assert (second.returncode, len(second.stderr.splitlines())) == (2, 1)
    assert "write another --port, or 0" in second.stderr
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 0
