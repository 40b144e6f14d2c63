"""How long the units of a plan take on several machines, by the seconds that each took on one."""

from __future__ import annotations

import heapq
from collections.abc import Mapping

from splatmill_worker.tiles.units import ScenePlan


def makespan(plan: ScenePlan, seconds: Mapping[str, float], machines: int) -> float:
    """Seconds until the scene is there, where every machine that is free takes the next unit that is ready.

    seconds: of each unit on a machine of its own; a unit that is not in it takes no time. Transfers take none either.
    """
    ended: dict[str, float] = {}
    free = [0.0] * machines
    left = list(plan.units)
    while left:
        # The unit that can begin first; of several, the first of the plan.
        ready = [unit for unit in left if all(need in ended for need in unit.needs)]
        unit = min(ready, key=lambda each: max((ended[need] for need in each.needs), default=0.0))
        left.remove(unit)
        begins = max(heapq.heappop(free), max((ended[need] for need in unit.needs), default=0.0))
        ended[unit.name] = begins + seconds.get(unit.name, 0.0)
        heapq.heappush(free, ended[unit.name])
    return max(ended.values())
