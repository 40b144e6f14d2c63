// composite, forward: the list of each tile front to back, sixteen pixels to a register, only the blocks that an ellipse reaches.
#include "compositing/blend.hpp"
#include "compositing/composite.hpp"
#include "compositing/waves.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

// The pixels of a block while its tile is blended. A finished pixel has its transmittance negated.
template <bool kDepth>
struct Block {
  alignas(64) float T[kLanes], red[kLanes], green[kLanes], blue[kLanes];
  alignas(64) float depth[kDepth ? kLanes : 1];
};

// The blocks of `live` with an unfinished pixel. Called now and then: a branch at every splat would cost more than it saves.
constexpr int64_t kEntriesBetweenChecks = 16;

template <bool kDepth>
SPLATMILL_INLINE uint32_t still_live(const Block<kDepth>* blocks, uint32_t live) {
  for (uint32_t left = live; left; left &= left - 1) {
    const int b = __builtin_ctz(left);
    if (all(load(blocks[b].T) < 0.0f)) live &= ~(1u << b);
  }
  return live;
}

template <bool kDepth, bool kWaves>
void blend_tile(Frame& frame, const Planes& image, const float background[3], int tile) {
  const Camera& cam = frame.camera;
  const int columns = cam.columns(), tile_x = tile % columns, tile_y = tile / columns;
  const float x0 = tile_x * kTile + 0.5f, y0 = tile_y * kTile + 0.5f;
  const TileLanes lanes = tile_lanes();
  const Float zero = splat(0.0f);

  Block<kDepth> blocks[kTileBlocks];
  for (int b = 0; b < kTileBlocks; ++b) {
    const Float x = lanes.pixel_x + (x0 + b % kBlocksAcross * kBlockSide), y = lanes.pixel_y + (y0 + b / kBlocksAcross * kBlockSide);
    const Mask inside = (x < static_cast<float>(cam.width)) & (y < static_cast<float>(cam.height));
    store(blocks[b].T, select(inside, splat(1.0f), splat(-1.0f)));
    store(blocks[b].red, zero);
    store(blocks[b].green, zero);
    store(blocks[b].blue, zero);
    if constexpr (kDepth) store(blocks[b].depth, zero);
  }

  uint32_t live = blocks_inside(tile_x, tile_y, cam);
  int64_t k = frame.offsets[tile];
  const int64_t begin = k, end = frame.offsets[tile + 1];
  for (; k < end; ++k) {
    if ((k - begin) % kEntriesBetweenChecks == 0 && !(live = still_live(blocks, live))) break;
    if (k + kEntriesAhead < end) __builtin_prefetch(&frame.records[frame.entries[k + kEntriesAhead].id]);
    Entry& entry = frame.entries[k];
    const Record& r = frame.records[entry.id];
    const TileForm form(r, lanes, x0, y0);
    const Float level = splat(r.level);
    const Float red = splat(r.color[0]), green = splat(r.color[1]), blue = splat(r.color[2]);
    const Wave* wave = kWaves ? frame.wave_of(entry.id) : nullptr;
    const WaveForm over(wave ? *wave : Wave{}, r, lanes, x0, y0);
    uint32_t changed = 0;
    for (uint32_t left = entry.blocks & live; left; left &= left - 1) {
      const int b = __builtin_ctz(left);
      Block<kDepth>& block = blocks[b];
      const Float e = log2_alpha(level, form.u_at(b), form.v_at(b));
      const Float alpha = min(exp2_of_alpha(e), kAlphaMax);
      const Float T = load(block.T), T_after = fnma(alpha, T, T);
      const Mask hit = e >= kLog2AlphaMin;
      const Mask blended = hit & (T_after > kTransmittanceMin);  // false for finished pixels: their T is negative
      const Float w = keep_product(blended, alpha, T);
      store(block.red, fma(w, red, load(block.red)));
      store(block.green, fma(w, green, load(block.green)));
      store(block.blue, fma(w, blue, load(block.blue)));
      if constexpr (kWaves) {
        if (wave) {
          const Float swing = w * cos_turns(over.turns_at(b));
          store(block.red, fma(swing, splat(wave->amplitude[0]), load(block.red)));
          store(block.green, fma(swing, splat(wave->amplitude[1]), load(block.green)));
          store(block.blue, fma(swing, splat(wave->amplitude[2]), load(block.blue)));
        }
      }
      if constexpr (kDepth) store(block.depth, fma(w, splat(r.depth), load(block.depth)));
      changed |= static_cast<uint32_t>(any(blended)) << b;
      store(block.T, mark(hit & ~blended, select(blended, T_after, T)));
    }
    entry.blocks = changed;
  }
  frame.walked[tile] = static_cast<int32_t>(k - begin);

  float* final_T = frame.final_T.get() + static_cast<int64_t>(tile) * kTile * kTile;
  for (int b = 0; b < kTileBlocks; ++b) {
    const Float T = abs(load(blocks[b].T));
    store(final_T + b * kLanes, T);
    const float* planes[3] = {blocks[b].red, blocks[b].green, blocks[b].blue};
    for (int c = 0; c < 3; ++c)
      store_block(block_origin(image, c, tile_x, tile_y, b), image.stride, fma(T, background[c], load(planes[c])));
    if constexpr (kDepth) {
      store_block(block_origin(image, kAlphaPlane, tile_x, tile_y, b), image.stride, 1.0f - T);
      store_block(block_origin(image, kDepthPlane, tile_x, tile_y, b), image.stride, load(blocks[b].depth));
    }
  }
}

}  // namespace

void composite_forward(Frame& frame, const Planes& image, bool with_alpha_and_depth, const float background[3], int threads) {
  const int tiles = frame.tiles();
  frame.final_T.reserve(static_cast<int64_t>(tiles) * kTile * kTile);
  frame.walked.reserve(tiles);
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(dynamic, 2)
    for (int tile = 0; tile < tiles; ++tile) {
      if (frame.with_waves && with_alpha_and_depth)
        blend_tile<true, true>(frame, image, background, tile);
      else if (frame.with_waves)
        blend_tile<false, true>(frame, image, background, tile);
      else if (with_alpha_and_depth)
        blend_tile<true, false>(frame, image, background, tile);
      else
        blend_tile<false, false>(frame, image, background, tile);
    }
  }
}

}  // namespace splatmill
