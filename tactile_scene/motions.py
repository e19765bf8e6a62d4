"""Names of the motions of bodies; what they are and how each moves a body is `tactile_sim.motions`."""

from __future__ import annotations

from typing import Any

from tactile_base.contract import Contract
from tactile_base.registry import Registry

FIXED, CARRIED = "fixed", "carried"

MOTIONS: Registry[Any] = Registry(
    "body motion",
    "tactile_servoing.motions",
    {
        FIXED: "tactile_sim.motions:Fixed",
        CARRIED: "tactile_sim.motions:Carried",
        "held": "tactile_sim.held:Held",
        "pushed": "tactile_sim.pushed:Pushed",
    },
    Contract(("scene", "body", "settings"), {"step": ("dt", "tools", "contacts")}, settings=True),
)
