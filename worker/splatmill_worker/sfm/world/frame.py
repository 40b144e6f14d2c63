"""Chooses the world of a reconstruction once, before training, and keeps it beside the reconstruction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatmill.schema import GeographicOrigin, KnownDistance, ModelFrame
from splatmill_worker.errors import Refusal
from splatmill_worker.images.exif import Exif
from splatmill_worker.scene import Float, Scene, Similarity
from splatmill_worker.sfm.world import geodesy, georeference
from splatmill_worker.sfm.world.upright import Down, down_of, focus_of

HEADING = 0.3
"""Length of the mean of the photos' horizontal directions, below which they were taken from all around."""


def choose(scene: Scene, tags: Sequence[Exif]) -> ModelFrame:
    """The frame of a reconstruction (decisions: frame): y down, the origin where the cameras look, metres by GPS.

    scene: as structure from motion made it.
    tags: those of the photo of each view.

    Where GPS does not tell metres, the median distance of the cameras from the origin is 1: viewers that look at the
    origin from a fixed distance then show the scene as the photos do. Training is not affected, because it has a scale
    of its own (`Normalization`).
    """
    down = _down(scene, tags)
    upright = Similarity(_turn(down.direction), 1.0, np.zeros(3))
    reasons = {"up": _up_sentence(down, len(scene.views))}
    level = upright.apply(scene)
    located = _located(level, tags)
    if isinstance(located, str):
        reasons["origin"] = f"The origin is the point that the cameras look at. Without GPS: {located}."
        reasons["unit"] = "The unit is arbitrary: the median distance of the cameras from the origin is 1."
        turn, reasons["heading"] = _heading(level)
        focus = _focus(level)
        scale = 1.0 / _distance(level, focus)
        centred = Similarity(turn, scale, -scale * turn @ focus)
        return _frame(upright.then(centred), "arbitrary", None, reasons)
    similarity, place, reasons["origin"], reasons["unit"] = located
    reasons["heading"] = "z points north, by GPS."
    return _frame(upright.then(similarity), "metre", place, reasons)


def in_frame(scene: Scene, frame: ModelFrame, known: KnownDistance | None) -> Scene:
    """The scene in its frame, whose unit becomes the metre where a distance is known.

    Raises Refusal when the distance is between photos without a camera, or at one place.
    """
    moved = Similarity.of(np.array(frame.from_sfm, np.float64)).apply(scene)
    if known is not None:
        scale = scale_by(moved, known)
        unit = f"Metres, because {known.first} and {known.second} were taken {known.metres:g} m apart."
        if frame.unit == "metre":
            unit += f" By GPS it would be {known.metres / scale:.3g} m."
        moved = in_metres(replace(moved, frame=frame), scale, unit)
        assert moved.frame is not None
        frame = moved.frame
    return replace(moved, frame=frame, notes=(*scene.notes, *frame.reasons.values()))


def in_metres(scene: Scene, scale: float, reason: str) -> Scene:
    """A scene with a frame, `scale` times as large, with the metre as its unit, and the sentence that says why."""
    assert scene.frame is not None
    resized = Similarity(np.eye(3), scale, np.zeros(3))
    frame = scene.frame.model_copy(
        update={
            "unit": "metre",
            "from_sfm": Similarity.of(np.array(scene.frame.from_sfm, np.float64))
            .then(resized)
            .matrix.tolist(),
            "reasons": scene.frame.reasons | {"unit": reason},
        }
    )
    return replace(resized.apply(scene), frame=frame)


def scale_by(scene: Scene, known: KnownDistance) -> float:
    """The factor by which a scene grows to metres. Raises Refusal."""
    centers = {view.photo: view.camera.center for view in scene.views}
    missing = [name for name in (known.first, known.second) if name not in centers]
    if missing:
        raise Refusal(
            "option_out_of_range",
            f"scale names {missing[0]}, whose camera was not recovered.",
            advice="Name two photos whose cameras are among those of the model.",
            facts={"missing": missing},
        )
    distance = float(np.linalg.norm(centers[known.first] - centers[known.second]))
    spread = float(np.linalg.norm(scene.centers - scene.centers.mean(axis=0), axis=1).max())
    if not distance > 1e-4 * spread:
        raise Refusal(
            "option_out_of_range",
            f"scale says that {known.first} and {known.second} were taken {known.metres:g} m apart, and their cameras "
            "are at one place.",
            advice="Name two photos that were taken far from each other.",
        )
    return known.metres / distance


def require_photos(known: KnownDistance | None, names: Sequence[str]) -> None:
    """Raise Refusal when a known distance names a photo that is not among `names`."""
    missing = [] if known is None else [name for name in (known.first, known.second) if name not in names]
    if missing:
        raise Refusal(
            "option_out_of_range",
            f"scale names {missing[0]}, and there is no such photo among the {len(names)}.",
            advice=f"Use the names of the photos as they were given, such as {names[0]}."
            if names
            else "Give photos.",
            facts={"missing": missing},
        )


def _down(scene: Scene, tags: Sequence[Exif]) -> Down:
    """Down by the photos, or by GPS where that is in doubt and GPS determines it."""
    down = down_of(np.array([view.camera.viewmat[:3, :3] for view in scene.views]))
    places = places_of(tags)
    known = np.isfinite(places).all(axis=1)
    if down.doubt is None or not known.any():
        return down
    fit = georeference.fit(scene.centers[known], geodesy.local(places[known], places[known][0]))
    by_gps = None if isinstance(fit, str) else georeference.down_by(fit)
    return down if by_gps is None else Down(by_gps, 0, None)


def _up_sentence(down: Down, count: int) -> str:
    if down.level == 0 and down.doubt is None:
        return "Up is upwards by GPS, because the photos alone leave it open."
    if down.doubt is not None:
        return f"Up is a guess: {down.doubt}."
    return f"Up is where {down.level} of {count} photos are held level."


def _turn(down: Float) -> Float:
    """A rotation [3,3] that takes `down` to y."""
    across = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    across /= np.linalg.norm(across)
    return np.stack([across, down, np.cross(across, down)])


def _heading(level: Scene) -> tuple[Float, str]:
    """A rotation [3,3] about y that takes the photos' direction to z, and why."""
    y = np.array([view.camera.viewmat[1, :3] for view in level.views])
    z = np.array([view.camera.viewmat[2, :3] for view in level.views])
    # Of a photo from above, its top counts as its front.
    ahead = z - y * z[:, 1:2]
    flat = ahead[:, [0, 2]]
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    mean = flat.mean(axis=0)
    if np.linalg.norm(mean) >= HEADING:
        reason = "z points where the photos look on the whole."
    else:
        first = min(range(len(level.views)), key=lambda index: level.views[index].name)
        mean, reason = flat[first], f"z points where {level.views[first].name} looks."
    angle = math.atan2(mean[0], mean[1])
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]), reason


def _located(level: Scene, tags: Sequence[Exif]) -> tuple[Similarity, GeographicOrigin, str, str] | str:
    """The similarity of an upright scene to metres, east and north around the point that its cameras look at.

    With it, where that point lies, and why the origin and the unit are known; else why not, as the end of a sentence.
    """
    places = places_of(tags)
    known = np.isfinite(places[:, :2]).all(axis=1)
    if not known.any():
        return "the photos have no positions"
    centers = level.centers
    has_altitude = bool(np.isfinite(places[known, 2]).all())
    places[~np.isfinite(places)] = 0.0
    base = np.median(places[known], axis=0)
    fit = georeference.fit(centers[known][:, [0, 2]], geodesy.local(places[known], base)[:, :2])
    if isinstance(fit, str):
        return fit
    # Altitudes are those above the ellipsoid or the sea, whichever the device gives; the difference is a constant.
    agreeing = fit.agreeing
    heights = geodesy.local(places[known], base)[agreeing, 2] + fit.scale * centers[known][agreeing, 1]
    similarity = georeference.level_similarity(fit, float(np.median(heights)) if has_altitude else 0.0)
    focus = similarity.points(_focus(level))
    east, down, north = focus
    latitude, longitude, altitude = geodesy.place(np.array([east, north, -down]), base)
    origin = GeographicOrigin(
        latitude=float(latitude),
        longitude=float(longitude),
        altitude=float(altitude) if has_altitude else None,
    )
    counted = f"{int(agreeing.sum())} of {int(known.sum())} photos agree within {fit.error:.1f} m"
    covered = float(np.linalg.norm(fit.spread))
    return (
        similarity.then(Similarity(np.eye(3), 1.0, -focus)),
        origin,
        f"The origin is the point that the cameras look at, located by GPS: {counted}.",
        f"Metres, by GPS, to about {100 * fit.error / covered / math.sqrt(agreeing.sum()):.1f} %: the photos cover "
        f"{covered:.0f} m (root mean square from their mean).",
    )


def places_of(tags: Sequence[Exif]) -> Float:
    """Latitude, longitude and altitude of each photo [n,3], NaN where it is not known."""
    rows = [
        [np.nan if value is None else value for value in (tag.latitude, tag.longitude, tag.altitude)]
        for tag in tags
    ]
    return np.array(rows, np.float64).reshape(-1, 3)


def _focus(scene: Scene) -> Float:
    return focus_of(scene.centers, np.array([view.camera.axis for view in scene.views]), scene.points)


def _distance(scene: Scene, focus: Float) -> float:
    """The median distance of the cameras from what they look at; of the points, where the cameras are there; else 1."""
    for places in (scene.centers, scene.points):
        distance = float(np.median(np.linalg.norm(places - focus, axis=1))) if len(places) else 0.0
        if distance > 1e-6:
            return distance
    return 1.0


def _frame(
    similarity: Similarity, unit: str, origin: GeographicOrigin | None, reasons: dict[str, str]
) -> ModelFrame:
    return ModelFrame.model_validate(
        {"unit": unit, "origin": origin, "from_sfm": similarity.matrix.tolist(), "reasons": reasons}
    )
