// composite, backward: the lists once more, front to back. What lies behind a splat is the final colour minus what was blended so
// far, so that no transmittance is recovered by division; a pixel ends where its transmittance equals that of the forward pass,
// bit for bit.
//
// The sums of a (tile, Gaussian) pair stay in registers over the tile's blocks, are reduced together and stored once; the pairs of
// a Gaussian are added later in a fixed order. There are no atomics, and results do not depend on the number of threads.
#include "compositing/blend.hpp"
#include "compositing/composite.hpp"
#include "compositing/waves.hpp"
#include "simd/shuffles.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

template <bool kDepth>
struct Block {
  alignas(64) float T[kLanes], final_T[kLanes];
  alignas(64) float behind[kLanes];  // gradient . (final image - what was blended so far)
  alignas(64) float d_red[kLanes], d_green[kLanes], d_blue[kLanes];
  alignas(64) float d_depth[kDepth ? kLanes : 1];
};

template <bool kDepth>
SPLATMILL_INLINE void load_block_gradient(const Frame& frame, const ImageGradient& g, int tile, int tile_x, int tile_y, int b,
                                          Block<kDepth>& block) {
  const Float final_T = load(frame.final_T.get() + (static_cast<int64_t>(tile) * kTileBlocks + b) * kLanes);
  Float behind = splat(0.0f);
  float* d_color[3] = {block.d_red, block.d_green, block.d_blue};
  for (int c = 0; c < 3; ++c) {
    const Float d = load_block(block_origin(g.gradient, c, tile_x, tile_y, b), g.gradient.stride);
    behind = fma(d, load_block(block_origin(g.image, c, tile_x, tile_y, b), g.image.stride), behind);
    store(d_color[c], d);
  }
  if constexpr (kDepth) {
    const Float d_depth = load_block(block_origin(g.gradient, kDepthPlane, tile_x, tile_y, b), g.gradient.stride);
    behind = fma(d_depth, load_block(block_origin(g.image, kDepthPlane, tile_x, tile_y, b), g.image.stride), behind);
    store(block.d_depth, d_depth);
    // alpha = 1 - final T, and a splat scales final T as it scales the colour behind it.
    const Float d_alpha = load_block(block_origin(g.gradient, kAlphaPlane, tile_x, tile_y, b), g.gradient.stride);
    behind = fnma(d_alpha, final_T, behind);
  }
  store(block.behind, behind);
  store(block.T, splat(1.0f));
  store(block.final_T, final_T);
}

// The wave moves with its Gaussian: what the phase gains by a move of the centre is added to the sums that the centre's gradient is
// made of, (2 ln 2 ux QU, 2 ln 2 (uy QU + vy QV)).
SPLATMILL_INLINE void move_with_gaussian(const Record& r, const Wave& wave, float* sums) {
  const double scale = 6.283185307179586 / (2.0 * 0.6931471805599453) * sums[kSumPhase];
  const double along_u = -wave.fx * scale / r.ux;
  sums[kSumQU] += static_cast<float>(along_u);
  sums[kSumQV] += static_cast<float>((-wave.fy * scale - r.uy * along_u) / r.vy);
}

template <bool kDepth, bool kWaves>
void differentiate_tile(Frame& frame, const ImageGradient& g, int tile) {
  constexpr int kCount = kWaves ? kWaveSums : kDepth ? kSums : kSumDepth;
  const int columns = frame.camera.columns(), tile_x = tile % columns, tile_y = tile / columns;
  const float x0 = tile_x * kTile + 0.5f, y0 = tile_y * kTile + 0.5f;
  const TileLanes lanes = tile_lanes();
  Block<kDepth> blocks[kTileBlocks];
  for (int b = 0; b < kTileBlocks; ++b) load_block_gradient(frame, g, tile, tile_x, tile_y, b, blocks[b]);

  int64_t k = frame.offsets[tile];
  const int64_t end = frame.offsets[tile + 1], walked = k + frame.walked[tile];
  for (; k < walked; ++k) {
    if (k + kEntriesAhead < walked) {
      __builtin_prefetch(&frame.records[frame.entries[k + kEntriesAhead].id]);
      __builtin_prefetch(&frame.pair_sums[static_cast<int64_t>(frame.entries[k + kEntriesAhead].slot) * kPairSums], 1);
    }
    const Entry entry = frame.entries[k];
    if (!entry.blocks) {
      frame.touches[entry.slot].blocks = 0;
      continue;
    }
    const Record& r = frame.records[entry.id];
    const TileForm form(r, lanes, x0, y0);
    const Float level = splat(r.level);
    const Float red = splat(r.color[0]), green = splat(r.color[1]), blue = splat(r.color[2]);
    const Wave* wave = kWaves ? frame.wave_of(entry.id) : nullptr;
    const WaveForm over(wave ? *wave : Wave{}, r, lanes, x0, y0);
    Float s[kCount];
    for (int i = 0; i < kCount; ++i) s[i] = splat(0.0f);
    const auto add_blocks = [&](auto may_clamp) __attribute__((always_inline)) {
      constexpr bool kMayClamp = decltype(may_clamp)::value;
      for (uint32_t left = entry.blocks; left; left &= left - 1) {
        const int b = __builtin_ctz(left);
        Block<kDepth>& block = blocks[b];
        const Float u = form.u_at(b), v = form.v_at(b);
        const Float e = log2_alpha(level, u, v);
        const Float raw = exp2_of_alpha(e), alpha = min(raw, kAlphaMax);
        const Float T = load(block.T), T_after = fnma(alpha, T, T);
        const Mask blended = (e >= kLog2AlphaMin) & (T_after >= load(block.final_T));
        const Float w = keep_product(blended, alpha, T);
        store(block.T, select(blended, T_after, T));
        const Float d_red = load(block.d_red), d_green = load(block.d_green), d_blue = load(block.d_blue);
        Float along = fma(blue, d_blue, fma(green, d_green, red * d_red));  // colour . gradient
        if constexpr (kDepth) along = fma(splat(r.depth), load(block.d_depth), along);
        if constexpr (kWaves) {
          if (wave) {
            const Float turns = over.turns_at(b), cosine = cos_turns(turns), swing = w * cosine;
            const Float d_cosine = fma(wave->amplitude[2], d_blue, fma(wave->amplitude[1], d_green, wave->amplitude[0] * d_red));
            along = fma(d_cosine, cosine, along);
            const Float slope = -(w * d_cosine * sin_turns(turns));  // dL/dphase, over 2 pi
            s[kSumPhase] += slope;
            s[kSumFrequencyX] = fma(slope, lanes.pixel_x + (over.dx + b % kBlocksAcross * kBlockSide), s[kSumFrequencyX]);
            s[kSumFrequencyY] = fma(slope, lanes.pixel_y + (over.dy + b / kBlocksAcross * kBlockSide), s[kSumFrequencyY]);
            s[kSumWaveRed] = fma(swing, d_red, s[kSumWaveRed]);
            s[kSumWaveGreen] = fma(swing, d_green, s[kSumWaveGreen]);
            s[kSumWaveBlue] = fma(swing, d_blue, s[kSumWaveBlue]);
          }
        }
        const Float gain = w * along;
        const Float behind = load(block.behind) - gain;
        store(block.behind, behind);
        Float q = fnma(keep_product(blended, alpha, reciprocal(1.0f - alpha)), behind, gain);  // alpha dL/dalpha
        if constexpr (kMayClamp) q = keep(raw <= splat(kAlphaMax), q);  // no gradient through the clamp
        const Float qu = q * u, qv = q * v;
        s[kSumQ] += q;
        s[kSumQU] += qu;
        s[kSumQV] += qv;
        s[kSumQUU] = fma(qu, u, s[kSumQUU]);
        s[kSumQUV] = fma(qu, v, s[kSumQUV]);
        s[kSumQVV] = fma(qv, v, s[kSumQVV]);
        s[kSumRed] = fma(w, d_red, s[kSumRed]);
        s[kSumGreen] = fma(w, d_green, s[kSumGreen]);
        s[kSumBlue] = fma(w, d_blue, s[kSumBlue]);
        if constexpr (kDepth) s[kSumDepth] = fma(w, load(block.d_depth), s[kSumDepth]);
      }
    };
    if (__builtin_expect(r.opacity > kAlphaMax * 0.9999f, 0))
      add_blocks(std::true_type{});
    else
      add_blocks(std::false_type{});
    float* sums = frame.pair_sums.get() + static_cast<int64_t>(entry.slot) * kPairSums;
    store_lane_sums<kCount>(sums, s);
    if constexpr (kWaves)
      if (wave) move_with_gaussian(r, *wave, sums);
  }
  for (; k < end; ++k) frame.touches[frame.entries[k].slot].blocks = 0;
}

}  // namespace

void composite_backward(Frame& frame, const ImageGradient& g, int threads) {
  const int tiles = frame.tiles();
  frame.pair_sums.reserve(frame.touches.capacity() * kPairSums);
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(dynamic, 2)
    for (int tile = 0; tile < tiles; ++tile) {
      if (frame.with_waves && g.with_alpha_and_depth)
        differentiate_tile<true, true>(frame, g, tile);
      else if (frame.with_waves)
        differentiate_tile<false, true>(frame, g, tile);
      else if (g.with_alpha_and_depth)
        differentiate_tile<true, false>(frame, g, tile);
      else
        differentiate_tile<false, false>(frame, g, tile);
    }
  }
}

}  // namespace splatmill
