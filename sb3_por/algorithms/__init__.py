"""The algorithms that users choose from: a visual actor-critic with an objective each."""

from sb3_por.algorithms.sac_curl import SACCURL
from sb3_por.algorithms.sac_drq import SACDrQ
from sb3_por.algorithms.sac_mrq import SACMRQ
from sb3_por.algorithms.sac_por import SACPOR
from sb3_por.algorithms.sac_spr import SACSPR
from sb3_por.algorithms.tqc_por import TQCPOR
from sb3_por.visual.actor_critic import VisualActorCritic

#: Name on the command line: class
ALGORITHMS: dict[str, type[VisualActorCritic]] = {
    "sac_por": SACPOR,
    "sac_drq": SACDrQ,
    "sac_curl": SACCURL,
    "sac_spr": SACSPR,
    "sac_mrq": SACMRQ,
    "tqc_por": TQCPOR,
}
