"""One switch at a time against the default: what each decision of the plan is worth."""

from __future__ import annotations

from _page import table
from _rows import Row

from _train.configurations import CONFIGURATIONS, DEFAULT, TAKEN_OUT
from _train.rows import Pair, compared, disturbed, grouped, lonely, once, whole
from _train.spread import Spread

ONE_SWITCH = """Differences to the default with the same seed. "Better" or "worse" only where every seed agrees, of at
least two. At budgets in steps the price is in the column of the time, from the runs that had the machine to
themselves; at budgets in seconds it is in the quality."""

BUSY = "busy machine"

SAME = "the default's plan is the same"

Place = tuple[str, str, str]
"""Key of a comparison: scene, budget, configuration."""


def ablation(rows: list[Row]) -> str:
    """The section: each switch over all scenes, each on each scene, and the default they are compared with."""
    pairs = compared(rows)
    alone = lonely(rows)
    left = [f"{alone} rows of a switch have no default of the same code, and are not shown."] if alone else []
    if not pairs:
        return "".join(left)
    order = {name: number for number, name in enumerate(CONFIGURATIONS)}
    places = sorted(pairs, key=lambda place: (order.get(place[2], len(order)), place))
    quality = {place: spread for place in places if (spread := difference(pairs[place], "psnr")) is not None}
    head = "switch|what|scene|budget|seeds|PSNR, dB|SSIM|training time, %|quality against the default"
    parts = [
        ONE_SWITCH,
        *([summary(quality)] if quality else []),
        table(head, [_line(place, pairs[place]) for place in places]),
        *_idle(pairs),
        *left,
        defaults(pairs),
    ]
    return "\n\n".join(parts)


def difference(pairs: list[Pair], name: str) -> Spread | None:
    """Median and range over seeds of the switch's value minus the default's; None without pairs of rows."""
    known = _comparable(pairs)
    if not known or all(_course(default) == _course(row) for default, row in known):
        return None
    return Spread.of(row[name] - default[name] for default, row in known)


def verdict(difference: Spread) -> str:
    """`better` or `worse` where all seeds agree in sign, otherwise that there is no clear difference."""
    if difference.count < 2:
        return "one seed says nothing"
    if difference.least > 0:
        return "better"
    if difference.largest < 0:
        return "worse"
    return "no clear difference"


def summary(quality: dict[Place, Spread]) -> str:
    """A table with a row per switch: where it was better or worse, and the median difference there."""
    lines = []
    for config in dict.fromkeys(config for _, _, config in quality):
        mine = {f"{place[0]}, {place[1]}": spread for place, spread in quality.items() if place[2] == config}
        where = [
            "; ".join(place for place, spread in mine.items() if verdict(spread) == word) or "nowhere"
            for word in ("better", "worse")
        ]
        over = Spread.of(spread.median for spread in mine.values())
        lines.append([f"`{config}`", len(mine), *where, over.text(2, signed=True)])
    return table("switch|places|better on|worse on|PSNR over the places: median of medians, dB", lines)


def defaults(pairs: dict[Place, list[Pair]]) -> str:
    """A table of the default configuration, with its range over seeds."""
    rows = whole(once([default for group in pairs.values() for default, _ in group]))
    lines = [
        [
            scene,
            budget,
            len(group),
            Spread.of(row["psnr"] for row in group).text(2),
            Spread.of(row["ssim"] for row in group).text(4),
            _seconds([row["seconds"]["train"] for row in group if not disturbed(row)], 1),
            f"{Spread.of(row['gaussians'] for row in group).median:.0f}",
        ]
        for (scene, budget), group in grouped(rows, "scene", "budget").items()
    ]
    return table(f"the {DEFAULT} on|budget|seeds|PSNR dB|SSIM|training s|Gaussians", lines)


def _line(place: Place, pairs: list[Pair]) -> list[object]:
    scene, budget, config = place
    known, name = _comparable(pairs), f"`{config}`"
    what = CONFIGURATIONS[config].what if config in CONFIGURATIONS else TAKEN_OUT.get(config, "")
    lost = f"{len(pairs) - len(known)} failed"
    quality, structure = difference(pairs, "psnr"), difference(pairs, "ssim")
    if quality is None or structure is None:
        return [name, what, scene, budget, len(known), "", "", "", SAME if known else lost]
    times = [
        100 * (row["seconds"]["train"] / default["seconds"]["train"] - 1)
        for default, row in known
        if not disturbed(default) and not disturbed(row)
    ]
    figures = [
        quality.text(2, signed=True),
        structure.text(4, signed=True),
        _seconds(times, 0, signed=True),
    ]
    said = verdict(quality) + (f"; {lost}" if len(known) < len(pairs) else "")
    return [name, what, scene, budget, len(known), *figures, said]


def _idle(pairs: dict[Place, list[Pair]]) -> list[str]:
    """A sentence that names the switches not measured on a scene because its plan already has them."""
    asked = {config for _, _, config in pairs} & CONFIGURATIONS.keys()
    by_config: dict[str, list[str]] = {}
    for (scene, budget), group in grouped(
        (default for pair in pairs.values() for default, _ in pair), "scene", "budget"
    ).items():
        for config in sorted(asked):
            plans = [row["plan"] for row in whole(group)]
            there = (scene, budget, config) in pairs
            if plans and not there and not any(CONFIGURATIONS[config].changes(plan) for plan in plans):
                by_config.setdefault(config, []).append(f"{scene} at {budget}")
    if not by_config:
        return []
    said = "; ".join(f"`{config}` on {', '.join(places)}" for config, places in by_config.items())
    return [f"Not measured, since the default's plan is that already: {said}."]


def _seconds(quiet: list[float], digits: int, *, signed: bool = False) -> str:
    return Spread.of(quiet).text(digits, signed=signed) if quiet else BUSY


def _comparable(pairs: list[Pair]) -> list[Pair]:
    return [pair for pair in pairs if len(whole(pair)) == 2]


def _course(row: Row) -> Row:
    """What affects a run: its plan but for the reasons, and what is done otherwise."""
    plan = {name: value for name, value in row["plan"].items() if name not in ("left_out", "forced")}
    return plan | {"instead": row.get("instead")}
