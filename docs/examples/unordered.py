"""mujoco_warp 4.0.0 with every flag of `opt.deterministic`: contacts and constraint rows still come in any order.

On a GPU this prints how many contacts and rows are elsewhere in a second run from one state; on a CPU, that none are.
The number of worlds may be given: python unordered.py 4096
"""

import sys

import mujoco
import mujoco_warp as mjw
import numpy as np

WORLDS = int(sys.argv[1]) if sys.argv[1:] else 4096
BALLS = "".join(f'<body pos="{x} {y} .09"><freejoint/><geom size=".1"/></body>' for x in (0, 0.19) for y in (0, 0.19))
mjm = mujoco.MjModel.from_xml_string(
    f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{BALLS}</worldbody></mujoco>'
)
model = mjw.put_model(mjm)
model.opt.deterministic = mjw.DeterminismType.ALL
data = mjw.make_data(mjm, nworld=WORLDS, nconmax=16, njmax=64)
qpos = np.tile(mjm.qpos0, (WORLDS, 1)).astype(np.float32)


def positions() -> dict[str, np.ndarray]:
    data.qpos.assign(qpos)
    mjw.fwd_position(model, data)
    count = int(data.nacon.numpy()[0])
    contacts = np.column_stack([data.contact.worldid.numpy(), data.contact.geom.numpy()])[:count]
    return {"contacts": contacts, "constraint rows": data.efc.id.numpy()}


first = positions()
for name in first:
    moved = max(int((positions()[name] != first[name]).any(axis=-1).sum()) for _ in range(10))
    print(f"{name}: up to {moved} of {len(first[name])} {'contacts' if name == 'contacts' else 'worlds'} differ")
