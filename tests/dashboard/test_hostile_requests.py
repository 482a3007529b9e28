"""Requests and experiments made to harm: each is refused in one line, and the dashboard answers the next."""

import gzip
import json
import socket
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from serving import Server, make

from msk_ray.config import dump_yaml
from msk_ray.dashboard.films import FOLDER
from msk_ray.dashboard.guard import Access
from msk_ray.dashboard.library import Library
from msk_ray.errors import ConfigError
from msk_ray.experiment.layout import MANIFEST_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.notes import load_notes
from msk_ray.report.reading import read_experiment
from msk_ray.status import main as status

JSON = "application/json"


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    (tmp_path / "secret.txt").write_text("secret")
    return make(tmp_path / "runs", "e")


@pytest.fixture
def served(experiment: Experiment) -> Iterator[Server]:
    server = Server(Library(experiment.path.parent, 0.01, True, None), Access(True, (), True))
    yield server
    server.close()


@pytest.mark.parametrize(
    "host",
    [
        "[127.0.0.1]evil.com",
        "127.0.0.1:80@evil.com",
        "localhost:80:evil.com",
        "evil.com#localhost",
        "localhost evil.com",
        "localhost..",
        "[::1]evil.com:80",
        "[::1",
        "[]",
        "127.0.0.1:",
        "127.0.0.1:port",
        "localhost/../evil.com",
        "localhost\t",
        "",
    ],
)
def test_a_host_that_is_no_name_is_nobodys(host: str) -> None:
    assert not Access(True, (), True).knows(host)
    assert not Access(False, ("desk.example",), False).knows(host)


def test_two_hosts_in_one_request_are_none(served: Server) -> None:
    with socket.create_connection(("127.0.0.1", served.port)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.com\r\nConnection: close\r\n\r\n")
        answer = connection.makefile("rb").read()
    assert answer.split()[1] in (b"400", b"421")


def test_the_body_of_a_refused_request_is_not_unpacked(
    served: Server, experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A megabyte in a kilobyte, from someone who may not write and from someone who may."""
    made: list[int] = []
    inflate = zlib.decompressobj

    def counted(*arguments: Any, **named: Any) -> Any:
        made.append(1)
        return inflate(*arguments, **named)

    monkeypatch.setattr(zlib, "decompressobj", counted)
    bomb = gzip.compress(json.dumps({"text": "x" * (1 << 20)}).encode())
    note = f"/e/e/trials/{experiment.trials()[0].id}/note"
    packed = {"Content_Type": JSON, "Content_Encoding": "gzip"}
    own = f"http://127.0.0.1:{served.port}"
    assert served.ask(note, "POST", bomb, **packed)[0] == 403
    assert served.ask(note, "POST", bomb, Origin="http://evil.example", **packed)[0] == 403
    assert served.ask(note, "POST", bomb, Origin=own, **packed)[0] == 415
    assert served.ask("/", "GET", bomb, **packed)[0] == 200
    assert made == []
    assert load_notes(experiment.path) == {}


@pytest.mark.parametrize(
    ("body", "headers", "expected"),
    [
        pytest.param(b"[" * 30_000, {}, 400, id="brackets"),
        pytest.param(b'{"text": ' + b'{"a":' * 100 + b"1" + b"}" * 101, {}, 400, id="nested a hundred deep"),
        pytest.param(b'{"text": "x"}', {"Content_Type": f"{JSON}; charset=bogus"}, 415, id="bogus charset"),
        pytest.param(b'{"text": "x"}', {"Content_Type": f"{JSON}; charset=utf-16"}, 415, id="another charset"),
        pytest.param(b'{"text": "x"}', {"Content_Encoding": "gzip"}, 415, id="false Content-Encoding"),
        pytest.param(b'{"text": "x"}', {"Content_Encoding": "nonsense"}, 415, id="unknown Content-Encoding"),
        pytest.param(b"\xff\xfe", {}, 400, id="not UTF-8"),
        pytest.param(b'{"text": "\x00"}', {}, 400, id="a NUL byte"),
        pytest.param(b'{"text": "\\ud800"}', {}, 400, id="half a character"),
        pytest.param(b"7", {}, 400, id="a number"),
        pytest.param(b'{"text": 7}', {}, 400, id="no text"),
        pytest.param(b"", {}, 400, id="nothing"),
        pytest.param(b'{"text": "' + b"x" * 3000 + b'"}', {}, 400, id="a long note"),
        pytest.param(b'{"text": "' + b"x" * (1 << 17) + b'"}', {}, 413, id="a large body"),
    ],
)
def test_a_hostile_note_is_refused_in_one_line(
    served: Server, experiment: Experiment, body: bytes, headers: dict[str, str], expected: int
) -> None:
    note = f"/e/e/trials/{experiment.trials()[0].id}/note"
    own = {"Content_Type": JSON, "Origin": f"http://127.0.0.1:{served.port}"}
    status, text, _ = served.ask(note, "POST", body, **(own | headers))
    assert (status, len(text.splitlines())) == (expected, 1), text
    assert load_notes(experiment.path) == {}
    assert served.ask(note, "POST", b'{"text": "mine"}', **own)[0] == 200


@pytest.mark.parametrize("linked", ["a file", "a folder"])
def test_a_link_does_not_lead_out_of_the_storage(linked: str, served: Server, experiment: Experiment) -> None:
    outside, trial = experiment.path.parents[1], experiment.trials()[0].id
    folder = experiment.trial_folder(trial)
    (experiment.path / FOLDER).mkdir()
    for name in ("eval.json", "best.pt"):
        (outside / name).write_text("secret")
    (folder / "eval.json").symlink_to(outside / "secret.txt")
    (experiment.path / FOLDER / "film_x.mp4").symlink_to(outside / "secret.txt")
    if linked == "a folder":
        (folder / "checkpoints").symlink_to(outside)
    else:
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "best.pt").symlink_to(outside / "secret.txt")
    # A sibling that the library would send in its place.
    (folder / "metrics.jsonl.gz").symlink_to(outside / "secret.txt")
    for path in (
        f"/e/e/trials/{trial}/eval.json",
        f"/e/e/trials/{trial}/checkpoints/best.pt",
        "/e/e/report/film_x.mp4",
    ):
        status, text, _ = served.ask(path)
        assert (status, len(text.splitlines())) == (404, 1), path
        assert "secret" not in text.replace("secret.txt", "")
    status, text, headers = served.ask(f"/e/e/trials/{trial}/metrics.jsonl", Accept_Encoding="gzip")
    assert (status, headers["Content-Encoding"], '"epoch"' in text) == (200, None, True)
    assert "secret" not in served.ask("/e/e/")[1]


@pytest.mark.parametrize("place", ["", "trials", "report", "a trial"])
def test_an_experiment_with_a_folder_elsewhere_is_refused_by_name(
    place: str, served: Server, experiment: Experiment
) -> None:
    outside = experiment.path.parents[1] / "outside"
    folder = experiment.trial_folder(experiment.trials()[0].id) if place == "a trial" else experiment.path / place
    folder.mkdir(exist_ok=True)
    folder.rename(outside)
    folder.symlink_to(outside)
    for path in ("/e/e/", "/e/e/version", "/e/e/plots", "/e/e/report/film_x.mp4", "/e/e/trials/x/metrics.jsonl"):
        status, text, _ = served.ask(path)
        assert (status, len(text.splitlines())) == (409, 1), path
        assert "is a link out of the storage: put the folder itself there" in text
    status, text, _ = served.ask("/")
    assert (status, "is a link out of the storage" in text) == (200, True)


def test_a_link_that_stays_within_the_storage_is_followed(served: Server, experiment: Experiment) -> None:
    (experiment.path.parent / "latest").symlink_to("e")
    assert served.ask("/e/latest/")[0] == 200


def test_a_film_is_sent_in_parts(served: Server, experiment: Experiment) -> None:
    (experiment.path / FOLDER).mkdir()
    (experiment.path / FOLDER / "film_x.mp4").write_bytes(bytes(range(65, 91)))
    status, text, headers = served.ask("/e/e/report/film_x.mp4", Range="bytes=2-4")
    assert (status, text, headers["Content-Type"]) == (206, "CDE", "video/mp4")


ENDPOINTS = ("/", "/version", "/compare?e=e", "/e/e", "/e/e/", "/e/e/version", "/e/e/plots", "/e/e/report/x.mp4")


@pytest.mark.parametrize("endpoint", [*ENDPOINTS, "/e/e/trials/T/metrics.jsonl", "/e/e/trials/T/note", "/static/x"])
def test_every_endpoint_refuses_strangers_and_other_methods(
    endpoint: str, served: Server, experiment: Experiment
) -> None:
    path = endpoint.replace("/T/", f"/{experiment.trials()[0].id}/")
    for host in ("evil.example", "[127.0.0.1]evil.com", "127.0.0.1:80@evil.com"):
        assert served.ask(path, Host=host)[0] == 421
    own = {"Content_Type": JSON, "Origin": f"http://127.0.0.1:{served.port}"}
    for method in ("PUT", "DELETE", "PATCH", "POST"):
        assert served.ask(path, method, b"{}", Content_Type=JSON)[0] == 403
        expected = 400 if method == "POST" and path.endswith("note") else 405
        assert served.ask(path, method, b"{}", **own)[0] == expected, method


@pytest.fixture
def orphaned(experiment: Experiment) -> Experiment:
    """The experiment of an environment and an algorithm of a package that is not installed here."""
    manifest = json.loads((experiment.path / MANIFEST_FILE).read_text())
    for number, entry in enumerate(manifest["trials"]):
        config = entry["config"]
        config["env"] |= {"name": "gone_package.robot:Robot", "own": {"gain": 2.0}}
        config["env"]["reward"] |= {"own_term": 1.0}
        config["physics"]["variant"] = "own_physics"
        if number % 2:
            del config["shac"]
            config["algorithm"] = {"name": "gone_package.learner:Learner", "settings": {"rate": 0.1}}
    (experiment.path / MANIFEST_FILE).write_text(json.dumps(manifest))
    folder = experiment.trial_folder("searched")
    folder.mkdir()
    (folder / "config.yaml").write_text(dump_yaml(manifest["trials"][2]["config"]))
    return experiment


def test_trials_of_a_class_that_is_not_here_are_shown_as_recorded(
    orphaned: Experiment, served: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    reading = read_experiment(orphaned, 0.0)
    assert [trial.score for trial in reading.trials] == [10.0, 11.0, 12.0, 13.0, None]
    (warning,) = {line for line in reading.warnings if "shown as recorded" in line}
    assert "env.name: no module 'gone_package'" in warning
    code, page, _ = served.ask("/e/e/")
    assert (code, page.count("<tr data-trial=")) == (200, 5)
    assert status([str(orphaned.path)]) == 0
    shown = capsys.readouterr().out
    assert all(trial.trial.id in shown for trial in reading.trials)
    with pytest.raises(ConfigError, match="no module 'gone_package'"):
        orphaned.trials()
