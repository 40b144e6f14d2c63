// median_depth: the list of each tile front to back, until every pixel has blended half of its light, or another share.
#include "bindings/rows.hpp"
#include "compositing/blend.hpp"
#include "compositing/composite.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

constexpr float kNearestHorizon = 1e-3f;

// The pixels of a block while its tile is walked. A finished pixel has its transmittance negated.
struct Block {
  alignas(64) float T[kLanes], depth[kLanes];
};

void depth_of_tile(Frame& frame, const float* tilts, float transmittance, const Planes& image, int tile) {
  const Camera& cam = frame.camera;
  const int columns = cam.columns(), tile_x = tile % columns, tile_y = tile / columns;
  const float x0 = tile_x * kTile + 0.5f, y0 = tile_y * kTile + 0.5f;
  const TileLanes lanes = tile_lanes();

  Block blocks[kTileBlocks];
  for (int b = 0; b < kTileBlocks; ++b) {
    store(blocks[b].T, splat(1.0f));
    store(blocks[b].depth, splat(0.0f));
  }
  uint32_t live = blocks_inside(tile_x, tile_y, cam);
  for (int64_t k = frame.offsets[tile]; k < frame.offsets[tile + 1] && live; ++k) {
    const Entry& entry = frame.entries[k];
    const Record& r = frame.records[entry.id];
    const TileForm form(r, lanes, x0, y0);
    const Float level = splat(r.level);
    const float* tilt = tilts + 2 * static_cast<int64_t>(entry.id);
    for (uint32_t left = entry.blocks & live; left; left &= left - 1) {
      const int b = __builtin_ctz(left);
      Block& block = blocks[b];
      const Float e = log2_alpha(level, form.u_at(b), form.v_at(b));
      const Float alpha = min(exp2_of_alpha(e), kAlphaMax);
      const Float T = load(block.T), T_after = fnma(alpha, T, T);
      const Mask open = T > 0.0f, hit = open & (e >= kLog2AlphaMin), passed = hit & (T_after <= transmittance);
      // Before that, no splat can end the pixel: a tenth of the light, times 1 - 0.999, is the least transmittance.
      const Float dx = lanes.pixel_x + (x0 + b % kBlocksAcross * kBlockSide - r.x);
      const Float dy = lanes.pixel_y + (y0 + b / kBlocksAcross * kBlockSide - r.y);
      const Float nearness = fnma(dy, splat(tilt[1]), fnma(dx, splat(tilt[0]), splat(1.0f)));
      store(block.depth, select(passed & (nearness > kNearestHorizon), splat(r.depth) / nearness, load(block.depth)));
      const Float left_over = mark(passed, select(hit, T_after, T));
      store(block.T, left_over);
      if (all(left_over < 0.0f)) live &= ~(1u << b);
    }
  }
  for (int b = 0; b < kTileBlocks; ++b)
    store_block(block_origin(image, 0, tile_x, tile_y, b), image.stride, load(blocks[b].depth));
}

}  // namespace

void bind_median_depth(nb::module_& m) {
  m.def(
      "median_depth",
      [](Frame& frame, Rows<2> means2d, Rows<3> conics, Row opacities, Rows<3> colors, Row depths, Rows<2> extents,
         Rows<2> tilts, float transmittance, Tensor<int64_t, nb::ndim<1>> offsets, Tensor<int32_t, nb::ndim<1>> ids,
         int width, int height, Image image, int threads) {
        const ProjectedRows rows{means2d.data(), conics.data(), opacities.data(), colors.data(), depths.data(), extents.data()};
        nb::gil_scoped_release release;
        frame.camera = Camera{};
        frame.camera.width = width, frame.camera.height = height;
        take_lists(frame, rows, static_cast<int64_t>(depths.shape(0)), offsets.data(), ids.data(),
                   static_cast<int64_t>(ids.shape(0)), threads);
        const Planes plane = planes_of(image, frame.camera);
        const int tiles = frame.tiles();
#pragma omp parallel num_threads(threads)
        {
          const FlushDenormals flush;
#pragma omp for schedule(dynamic, 2)
          for (int tile = 0; tile < tiles; ++tile) depth_of_tile(frame, tilts.data(), transmittance, plane, tile);
        }
      },
      "frame"_a, "means2d"_a.noconvert(), "conics"_a.noconvert(), "opacities"_a.noconvert(), "colors"_a.noconvert(),
      "depths"_a.noconvert(), "extents"_a.noconvert(), "tilts"_a.noconvert(), "transmittance"_a, "offsets"_a.noconvert(), "ids"_a.noconvert(),
      "width"_a, "height"_a, "image"_a.noconvert(), "threads"_a,
      "Writes to one plane the depth at which the transmittance of each pixel falls to the one given, and 0 where it stays above.");
}

}  // namespace splatmill
