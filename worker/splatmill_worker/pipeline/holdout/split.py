"""Which photos of a capture are held out: evenly spread or named ones, and none that a training photo resembles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from splatmill.schema import MIN_PHOTOS, TrainOptions
from splatmill.schema.quantities import counted, listed
from splatmill_worker.errors import Refusal
from splatmill_worker.images.copies import warning as copies_warning
from splatmill_worker.pipeline.holdout.near_copies import near_copies, same_photos
from splatmill_worker.scene import Scene, View, split

MOST_NEAR = 0.5
"""Share of the training views that may be left out as near copies of held-out ones."""


@dataclass(frozen=True)
class Split:
    """The views to train on and the held-out ones.

    training, held_out: the views.
    left_out: the name of each view that is in neither, and the reason.
    warnings: sentences for the user.
    """

    training: tuple[View, ...]
    held_out: tuple[View, ...]
    left_out: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()


def honest_split(scene: Scene, options: TrainOptions) -> Split:
    """Return the views of `split_views`, without copies, and to train on none that is a near copy of a held-out one.

    Where these are more than MOST_NEAR of the training views, as in a slow video, `split` holds out every 16th view
    instead of every 8th, and so on; where even that does not help, all are kept and a warning says what that means.
    Raises as `split_views` does.
    """
    named = set(options.test_views or ())
    held = named | ({view.name for view in scene.views if view.split == "test"} if not named else set())
    same = same_photos(scene)
    # A copy on the other side of the split is a near copy below.
    copies = {name: original for name, original in same.items() if (name in held) == (original in held)}
    chosen = replace(scene, views=tuple(view for view in scene.views if view.name not in copies))
    left_out = [(name, f"it shows the same as {original}") for name, original in copies.items()]
    warnings = copies_warning(list(copies.items()))
    step = options.holdout
    while True:
        train, test = split_views(chosen, options.model_copy(update={"holdout": step}))
        near = near_copies(scene, test, train, same)
        explicit = options.test_views is not None or any(view.split == "test" for view in test)
        if len(near) <= MOST_NEAR * len(train) or explicit or len(test) < 2:
            break
        step *= 2
    if len(near) > MOST_NEAR * len(train):
        train, test = split_views(chosen, options)
        copy, original = next(iter(near.items()))
        warnings.append(
            "Most photos were taken from nearly the same place as a held-out one, so the held-out PSNR says little "
            f"about other views: {copy} and {original}, for example. Give photos from more places."
        )
    elif near:
        copy, original = next(iter(near.items()))
        spaced = (
            "" if step == options.holdout else f" Every {step}th photo is held out, since so many are alike."
        )
        warnings.append(
            f"{counted(len(near), 'photo is', 'photos are')} not trained on, since a held-out one was "
            f"taken from nearly the same place, such as {original} and {copy}: the training would be shown what it is "
            f"judged by.{spaced}"
        )
        left_out += [
            (name, f"it is nearly the same as {held}, which is held out") for name, held in near.items()
        ]
        train = tuple(view for view in train if view.name not in near)
    return Split(train, test, tuple(left_out), (*warnings, *_few(train, test)))


def _few(train: Sequence[View], test: Sequence[View]) -> list[str]:
    """A warning where so few photos are trained on that most of the scene is seen from one side; none otherwise."""
    if len(train) >= MIN_PHOTOS:
        return []
    trained = f"Only {counted(len(train), 'photo is', 'photos are')} trained on"
    held = (
        f", and {counted(len(test), 'photo is', 'photos are')} held out" if test else ", and none is held out"
    )
    advice = " or hold out fewer with the options holdout and test_views" if test else ""
    return [
        f"{trained}{held}. What fewer than {MIN_PHOTOS} photos show has no certain depth, so views from other places "
        f"will be wrong. Give more photos{advice}: 20 or more make a good scene."
    ]


def split_views(scene: Scene, options: TrainOptions) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Return the views to train on and the held-out ones.

    The held-out views are those that the option `test_views` names. Without that option they are chosen by `split`:
    the test views of the data set, or else every `holdout`-th view. Raises Refusal when a name is unknown or no view is
    left to train on.
    """
    if options.test_views is not None:
        names = set(options.test_views)
        unknown = sorted(names - {view.name for view in scene.views})
        if unknown:
            raise Refusal(
                "holdout_empty",
                f"test_views has {len(unknown)} of {len(names)} names that belong to no photo with a camera: "
                f"{listed(unknown)}.",
                advice="Use the names of the photos in the capture, and only photos whose cameras were recovered.",
                facts={"unknown": unknown},
            )
        ordered = sorted(scene.views, key=lambda view: view.name)
        train = tuple(view for view in ordered if view.name not in names)
        test = tuple(view for view in ordered if view.name in names)
    else:
        try:
            train, test = split(scene, options.holdout)
        except ValueError as error:
            raise Refusal(
                "holdout_empty", str(error), advice="Set holdout to 2 or more, or to 0 to hold out none."
            ) from error
    if not train:
        raise Refusal(
            "holdout_empty",
            f"All {len(test)} photos with a camera are held out, so no photo is left to train on.",
            advice="Hold out fewer photos: name fewer in test_views, or set a larger holdout.",
        )
    return train, test
