"""`evaluate --in myosuite`, as an entry point declares it; read before torch is loaded."""

from msk_ray.evaluate.foreign_scoring import ForeignScoring

MYOSUITE = ForeignScoring(
    name="myosuite",
    package="MyoSuite",
    version="2.12",
    requirement="myosuite==2.12.2",
    summary="myosuite: a policy of env myosuite_walk in the unmodified CPU environment of MyoSuite 2.12, 20 episodes "
    "with its own resets and 20 with random ones",
    scorer_class="msk_ray.legs.myosuite_walk.scoring:MyoSuiteScorer",
)
