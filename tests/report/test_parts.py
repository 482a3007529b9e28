"""An experiment over several environments: a part of the page for each, because their scores cannot be compared."""

import re
import time
from pathlib import Path

import pytest
from bodies import make_bodies

from msk_ray.report.__main__ import main
from msk_ray.report.charts import Plot
from msk_ray.report.curves import learning_curves
from msk_ray.report.page import places_of
from msk_ray.report.reading import read_experiment
from msk_ray.report.tables import baseline_of, by_variant_and_environment, compare_variants

pytestmark = pytest.mark.long


def test_each_environment_is_a_part_of_the_page(tmp_path: Path) -> None:
    made = make_bodies(tmp_path)
    reading = read_experiment(made, time.time())
    parts = reading.parts()
    assert [(part.name, len(part.trials)) for part in parts] == [("bodies: hopper", 4), ("bodies: cheetah", 4)]
    assert parts[0].parts() == [parts[0]]
    rows = compare_variants(parts[0], baseline_of(parts[0], None))
    # Scores 8 and 12, and 4 and 6.
    assert [(row.variant, row.mean, row.worst, row.env_steps, row.seconds, row.difference) for row in rows] == [
        ("fast", 10.0, 8.0, 400.0, 12.0, 5.0),
        ("SHAC", 5.0, 4.0, 400.0, 6.0, None),
    ]
    assert rows[0].std == pytest.approx(8.0**0.5)
    matrix = by_variant_and_environment(parts)
    assert {name: [row and row.mean for row in cells] for name, cells in matrix.items()} == {
        "SHAC": [5.0, 500.0],
        "fast": [10.0, 1000.0],
    }
    # Seed 0 ends after half the time of seed 1; a mean beyond would be of seed 1 alone.
    times = learning_curves(parts[0].variants, None, "times", places_of(parts), over="seconds")
    assert times is not None
    (plot,) = times.chart.panels
    assert isinstance(plot, Plot)
    means = {times.chart.styles[line.style].name: line for line in plot.lines if line.when == "unfiltered"}
    assert {name: line.x[-1] for name, line in means.items()} == {"fast": 8.0, "SHAC": 4.0}
    # Seed 0 has its last score, 4, where seed 1 is half way to 6.
    assert means["SHAC"].y[-1] == 3.5
    assert main([str(made.path), "--best", "never"]) == 0
    page = (made.path / "report" / "index.html").read_text()
    assert "<h1>bodies</h1>" in page
    assert "Scores of different environments cannot be compared" in page
    shown = " ".join(re.sub(r"<[^>]*>", " ", page[page.index('id="matrix"') :]).split())
    assert "SHAC 5 ± 1.4142 worst 4, 2 of 2 seeds at 400 env steps, 6s 500 ± 141.42 worst 400" in shown
    assert page.count("<p>Which?</p>") == 1 == page.count("<summary>space.yaml"), "once, not in each part"
    assert page.index("<p>Which?</p>") < page.index('id="matrix"')
    assert 'data-figure="1_curves"' in page
    assert 'data-figure="2_curves"' in page
