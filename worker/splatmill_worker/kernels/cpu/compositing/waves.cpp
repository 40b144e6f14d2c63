// What surrounds the blending of waves: taking them from a caller, and adding up their gradients.
#include "compositing/waves.hpp"

#include <stdexcept>
#include <string>

#include "compositing/composite.hpp"
#include "simd/threads.hpp"

namespace splatmill {

namespace {

constexpr float kNyquist = 0.5f;  // cycles per pixel

bool drawn(const Wave& wave) {
  if (!(std::abs(wave.fx) <= kNyquist && std::abs(wave.fy) <= kNyquist && std::isfinite(wave.phase))) return false;
  return std::isfinite(wave.amplitude[0]) && std::isfinite(wave.amplitude[1]) && std::isfinite(wave.amplitude[2]);
}

}  // namespace

void take_waves(Frame& frame, const float* waves, int64_t count, const int32_t* rows, int64_t gaussians) {
  Wave* to = frame.waves.reserve(count);
  for (int64_t i = 0; i < count; ++i) {
    const float* w = waves + kWaveFloats * i;
    to[i] = {w[0], w[1], w[2], {w[3], w[4], w[5]}};
  }
  std::vector<bool> taken(count);
  int32_t* numbers = frame.wave_rows.reserve(gaussians);
  for (int64_t i = 0; i < gaussians; ++i) {
    if (rows[i] >= count)
      throw std::invalid_argument("wave_rows[" + std::to_string(i) + "] is " + std::to_string(rows[i]) + ", but there are " +
                                  std::to_string(count) + " waves.");
    if (rows[i] >= 0 && taken[rows[i]])
      throw std::invalid_argument("wave_rows[" + std::to_string(i) + "] is " + std::to_string(rows[i]) + ", the wave of another Gaussian.");
    if (rows[i] >= 0) taken[rows[i]] = true;
    numbers[i] = rows[i] >= 0 && drawn(to[rows[i]]) ? rows[i] : -1;
  }
}

void gradients_of_waves(const Frame& frame, const uint16_t* visible, float* out, int threads) {
  constexpr double kTurn = 6.283185307179586;
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(static)
    for (int64_t i = 0; i < frame.count; ++i) {
      const int32_t row = frame.wave_rows[i];
      if (row < 0 || (visible && !(visible[i / kLanes] >> (i % kLanes) & 1))) continue;
      const Span span = frame.spans[i];
      double s[kWaveFloats] = {};
      bool any = false;
      for (uint32_t k = span.first; k < span.first + span.count; ++k) {
        if (!frame.touches[k].blocks) continue;
        any = true;
        const float* pair = &frame.pair_sums[static_cast<int64_t>(k) * kPairSums] + kSumFrequencyX;
        for (int j = 0; j < kWaveFloats; ++j) s[j] += pair[j];
      }
      if (!any) continue;
      for (int j = 0; j < kWaveFloats; ++j) out[kWaveFloats * row + j] = static_cast<float>(j < 3 ? kTurn * s[j] : s[j]);
    }
  }
}

}  // namespace splatmill
