# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""Prose of the report: the unit, and why an engine's line is not flat along an axis."""

from _functions.tolerances import EXP2_ERROR, U

UNIT = f"""\
**The unit.** Every input (parameters, camera, the image's gradient) is moved at random by the unit roundoff of float32, 2^-24, in the
root mean square; the root mean square change of an output over eight such draws, in float64, is its condition number times
the unit roundoff. To it are added, as squares, the change by an error of {EXP2_ERROR:.1e} of every 2^x, which is what the kernels' polynomial has
by design ({EXP2_ERROR / U:.0f} roundoffs, `functions.md`), and half an ulp of the output. An error of 1 is a backward stable algorithm's; a condition
number that is itself large does not show here, because no algorithm can do better."""

HIDDEN = """\
**Gaussians behind others.** The backward pass takes what lies behind a splat as the final colour minus what was blended so far, which has
the rounding of the whole pixel. The gradient of a Gaussian behind a transmittance T is smaller by T, so this rounding is up to 2^-24 / T
of it: 6e-4 where T is at its end of 1e-4, ten thousand units. The column `with the difference` adds exactly that rounding to the unit, drawn at random
for every splat and pixel; where it falls back to the limit, this is the whole reason. The gradients concerned are the smallest
of the scene, so the norm over all Gaussians hardly shows it. Autograd in the reference has no such difference.
It is a matter of time, not of the method: a backward pass from the back to the front, which sums what lies behind and takes T before
a splat from T after it over 1 - alpha, was within 6 units at the seven values of six other axes it was tried at, and within 34 on a list of 1,000 (where it is the
error of 2^x that remains). It costs more than a tenth of both passes (`optimisations.md`) and is not used."""

REASONS = {
    "beside": (
        "Over a tile 3000 pixels from the centre, u = ux dx + uy dy of a needle is a difference of two numbers of thousands, and every tile rounds "
        "them anew. This is one or two Gaussians of 24: the median is 1 unit and the norm over all 2. An untested explanation: inputs move a needle as a whole, which may by chance "
        "leave its gradient as it is, while the roundings of tiles are independent of one another. "
        "Where the three numbers of a conic are rounded instead, the same happens to a "
        "dx^2 + 2 b dx dy + c dy^2, whose terms are millions: the pixels come out wrong altogether."
    ),
    "axis_ratio": (
        "The fused step keeps the triangular factor of the conic and is flat. The op chain passes three float32 numbers from one op to the "
        "next; they determine the short axis only to the axis ratio squared times the roundoff. The reference in float32 also "
        "differentiates through the determinant."
    ),
    "grazing": "From 100 on, a grazing plane is a needle. Facing the camera (value 1), most Gaussians are behind others.",
    "focal": "At short focal lengths all of the scene is behind a few splats.",
    "list_length": (
        "From 1000 on, most of the list is behind others. The pixels are off by 23 units because 2^x has an error with a sign, which is "
        "the same for many splats whose alphas are nearly equal, and adds up."
    ),
    "opacity": (
        "The reference in float32 lets autograd form o (1 - o), which cancels; the kernels use o e^-x / (1 + e^-x)."
    ),
}

WORST = """\
- **Means and pose of the fused step, centres far off.** The gradient to depth is -(du x/z + dv y/z + s) / z, where du and dv are the gradients to
x/z and y/z, and s is that to all three log-scales at once (`with_inv_z` in `project_backward`). Let m be the projected centre, c the principal point and p
the pixels that the Gaussian reaches. The first two terms are those of m - c, and the third takes them away again, all but p - c: nearer by a
factor, a Gaussian is larger by it and farther off by it, and looks the same. The sum loses |m - c| / |p - c|, which the unit does not show,
since a change of the inputs moves all three terms together. Where the worst pose was found, 320,000 pixels off and at the near plane, the
terms are -59, 8 and 51, and their sum is 0.006. Nothing would cancel if every (tile, Gaussian) pair summed over offsets to the principal point
instead of the centre. That is not done: it takes centres of 10^5 pixels to lose two digits.
- **The op chain** passes conics of three float32 numbers, as in `stability.md`. There is no bound.

What had been above: u = ux dx + uy dy over the pixels of a tile is a difference of numbers as large as the centre is far off. Rounded for each pixel,
it was noise, where rounding the centre moves all pixels at once; the sum over pixels behind an opacity's gradient, which such a
motion hardly changes, showed it. It is rounded once for a tile (`TileForm`)."""
