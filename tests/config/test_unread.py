"""A setting that another one leaves without effect is refused."""

from typing import Any

import pytest

from msk_ray.config import overlay, parse_config
from msk_ray.errors import ConfigError

UNREAD: list[tuple[dict[str, Any], str, Any, dict[str, Any]]] = [
    ({"shac.lr_schedule": "constant"}, "shac.final_lr", 1e-4, {"shac.lr_schedule": "linear"}),
    ({"shac.state_bptt": False}, "shac.state_grad_clip", 10.0, {"shac.state_bptt": True}),
    ({"physics.variant": "published"}, "physics.solreffriction", [1.0, 1.0], {"physics.cone": "elliptic"}),
    (
        {"physics.variant": "published", "curriculum": {"start": {"solref": [0.1, 1.0]}, "epochs": 3}},
        "curriculum.start.solreffriction",
        [1.0, 1.0],
        {"physics.cone": "elliptic"},
    ),
    (
        {"env": {"name": "myoleg26", "terrain": {"kind": "slope"}}},
        "env.terrain.roughness",
        0.1,
        {"env.terrain.kind": "rough"},
    ),
    ({"env": {"name": "myoleg26"}}, "env.terrain.slope", 0.2, {"env.terrain.kind": "slope"}),
    ({"env": {"name": "myoleg26"}}, "env.assist.power", 2.0, {"env.assist.epochs": 10}),
    ({"env": {"name": "myoleg", "model": "legs.xml"}}, "env.source", "myo_sim", {"env.model": "myolegs26"}),
]


@pytest.mark.parametrize(("changes", "key", "value", "remedy"), UNREAD, ids=[case[1] for case in UNREAD])
def test_a_setting_that_another_leaves_unread_is_refused(
    changes: dict[str, Any], key: str, value: Any, remedy: dict[str, Any]
) -> None:
    settings = overlay({"env": {"name": "ant"}}, changes)
    parse_config(parse_config(settings).as_dict())  # a trial's config.yaml holds every field, at its default
    with pytest.raises(ConfigError) as caught:
        parse_config(overlay(settings, {key: value}))
    assert str(caught.value).startswith(f"config: {key}: nothing reads it while ")
    assert "leave it out" in str(caught.value)
    parse_config(overlay(overlay(settings, {key: value}), remedy))
