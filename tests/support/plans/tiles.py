"""Options of a short training in two tiles."""

from splatmill.schema import TrainOptions

TWO_TILES = TrainOptions.model_validate(
    {
        "steps": 100,
        "seed": 1,
        "max_gaussians": 2000,
        "holdout": 5,
        "tiles": 2,
        "backend": "cpu",
        "lpips": "off",
    }
)
