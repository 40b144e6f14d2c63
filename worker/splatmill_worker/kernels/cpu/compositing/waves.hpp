// The waves of Gaussians: a second colour, times a cosine over the image (Gabor functions; Wurster et al. 2024).
#pragma once

#include <cmath>

#include "compositing/blend.hpp"

namespace splatmill {

// cos(2 pi t) within 2.5e-7, for |t| < 2^22: the sine of what is left to a quarter turn, by its Taylor polynomial of degree 11,
// whose remainder is 5.7e-8 there.
SPLATMILL_INLINE Float cos_turns(Float t) {
  const Float x = (splat(0.25f) - abs(t - floor(t + 0.5f))) * 6.283185307f, xx = x * x;
  Float p = splat(-2.50521084e-8f);
  p = fma(p, xx, 2.75573192e-6f);
  p = fma(p, xx, -1.98412698e-4f);
  p = fma(p, xx, 8.33333333e-3f);
  p = fma(p, xx, -1.66666667e-1f);
  return fma(p * xx, x, x);
}
SPLATMILL_INLINE Float sin_turns(Float t) { return cos_turns(t - 0.25f); }

// A wave over a tile: its phase at block b is the lanes' part plus the offset of the block.
struct WaveForm {
  float fx, fy;   // cycles per pixel
  float dx, dy;   // the tile's first pixel centre (x0, y0) from that of the Gaussian, pixels
  Float turns;

  SPLATMILL_INLINE WaveForm(const Wave& wave, const Record& r, const TileLanes& lanes, float x0, float y0)
      : fx(wave.fx), fy(wave.fy), dx(x0 - r.x), dy(y0 - r.y) {
    // Whole turns are taken off in double: for a centre far off, float32 would hold no fraction.
    const double first = static_cast<double>(fx) * dx + static_cast<double>(fy) * dy + wave.phase;
    turns = fma(fx, lanes.pixel_x, fma(fy, lanes.pixel_y, splat(static_cast<float>(first - std::floor(first)))));
  }
  SPLATMILL_INLINE Float turns_at(int block) const {
    return turns + (fx * (block % kBlocksAcross * kBlockSide) + fy * (block / kBlocksAcross * kBlockSide));
  }
};

// Copies the waves [count] and the number of the wave of each of `gaussians`, below 0 for none, into the frame. A wave that is not
// finite, or has more than half a cycle per pixel in x or y, counts as none. Throws std::invalid_argument for a number beyond.
void take_waves(Frame& frame, const float* waves, int64_t count, const int32_t* rows, int64_t gaussians);

// Adds up the pair sums of each wave into `out` [count][6]; rows of waves that were not blended keep what they hold. Gaussians whose
// bit in `visible` is 0, if given, have no pairs.
void gradients_of_waves(const Frame& frame, const uint16_t* visible, float* out, int threads);

}  // namespace splatmill
