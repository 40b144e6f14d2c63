// project: Gaussians to the image plane, as a separate differentiable op and as the first pass of a frame.
#include "projection/project.hpp"

#include <vector>

#include "bindings/arguments.hpp"
#include "bindings/rows.hpp"
#include "projection/geometry.hpp"
#include "projection/pose.hpp"
#include "simd/shuffles.hpp"
#include "tiles/touches.hpp"

namespace splatmill {
namespace {

// The colours of a block, clamped at 0 from below. A Gaussian whose colour is not finite becomes invisible.
SPLATMILL_INLINE void shade(const float* p, const Camera& cam, int degree, Projection& o, Float* color) {
  Float inv_distance, basis[16];
  const Direction d = view_direction(p, cam, inv_distance);
  sh_basis(degree, d, basis);
  sh_color(p, basis, degree, color);
  for (int c = 0; c < 3; ++c) {
    o.visible &= is_finite(color[c]);
    color[c] = max(color[c], 0.0f);
  }
}

// The sixteen records of a block, one per vector.
SPLATMILL_INLINE void make_records(const Projection& o, const Float* color, Float* records) {
  const Factor f = conic_factor(o.b, o.c, o.det);
  records[kRecordX] = o.x2d, records[kRecordY] = o.y2d;
  records[kRecordUx] = f.ux, records[kRecordUy] = f.uy, records[kRecordVy] = f.vy;
  records[kRecordLevel] = o.cut + kLog2AlphaMin;
  for (int c = 0; c < 3; ++c) records[kRecordRed + c] = color[c];
  records[kRecordDepth] = o.z;
  records[kRecordCut] = o.cut;
  records[kRecordSlopeX] = o.b / o.c, records[kRecordSlopeY] = o.b / o.a;
  records[kRecordExtentX] = o.extent_x, records[kRecordExtentY] = o.extent_y;
  records[kRecordOpacity] = o.opacity;
  transpose(records);
}

}  // namespace

void project_frame(const float* blocks, int64_t count, int degree, Frame& frame, int threads, const Clusters* clusters) {
  const Camera cam = frame.camera;
  const Visited visited(count, clusters);
  const int64_t all = blocks_for(count);
  frame.visible.reserve(all);
  if (clusters) std::fill_n(frame.visible.get(), all, uint16_t{0});
  collect_touches(frame, count, visited.blocks(), threads, [&](int64_t begin, int64_t end, TouchWriter& writer) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t b = visited.block(i);
      const float* p = blocks + b * kBlockFloats;
      uint32_t seen = 0;
      Projection o;
      project_geometry(p, cam, o);
      o.visible &= mask_of(lanes_of(b, count));
      if (any(o.visible)) {
        Float color[3], records[kLanes];
        shade(p, cam, degree, o, color);
        make_records(o, color, records);
        for (uint32_t left = bits(o.visible); left; left &= left - 1) {
          const int lane = __builtin_ctz(left);
          const int64_t id = b * kLanes + lane;
          Record record;
          store(reinterpret_cast<float*>(&record), records[lane]);
          frame.records[id] = record;
          if (writer.add(static_cast<uint32_t>(id), record)) seen |= 1u << lane;
        }
      }
      frame.visible[b] = static_cast<uint16_t>(seen);
    }
  });
}

namespace {

void project_rows(const float* blocks, int64_t count, int degree, const Camera& cam, const ProjectedRows& out, int threads) {
  const int64_t n = blocks_for(count);
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(static)
    for (int64_t b = 0; b < n; ++b) {
      const float* p = blocks + b * kBlockFloats;
      Projection o;
      project_geometry(p, cam, o);
      Float color[3], fields[kProjectedFloats];
      shade(p, cam, degree, o, color);
      fields[kMeanX] = o.x2d, fields[kMeanY] = o.y2d;
      fields[kConicA] = o.c / o.det, fields[kConicB] = -(o.b / o.det), fields[kConicC] = o.a / o.det;
      fields[kOpacity] = o.opacity;
      for (int c = 0; c < 3; ++c) fields[kRed + c] = color[c];
      fields[kDepth] = o.z;
      fields[kExtentX] = o.extent_x, fields[kExtentY] = o.extent_y;
      alignas(64) float lanes[kProjectedFloats][kLanes];
      for (int f = 0; f < kProjectedFloats; ++f) store(lanes[f], keep(o.visible, fields[f]));
      const int used = static_cast<int>(std::min<int64_t>(kLanes, count - b * kLanes));
      for (int l = 0; l < used; ++l) {
        const int64_t i = b * kLanes + l;
        for (int f = 0; f < 2; ++f) {
          out.means2d[2 * i + f] = lanes[kMeanX + f][l];
          out.extents[2 * i + f] = lanes[kExtentX + f][l];
        }
        for (int f = 0; f < 3; ++f) {
          out.conics[3 * i + f] = lanes[kConicA + f][l];
          out.colors[3 * i + f] = lanes[kRed + f][l];
        }
        out.opacities[i] = lanes[kOpacity][l];
        out.depths[i] = lanes[kDepth][l];
      }
    }
  }
}

// The gradient of the op. With D the gradient to the conic C = Sigma'^-1, given as its upper triangle, that to Sigma' is -C D C.
void project_rows_backward(const float* blocks, int64_t count, int degree, const Camera& cam, const ProjectedRows& d,
                           float* grad_blocks, float* d_viewmat, int threads) {
  constexpr int64_t kChunk = 64;  // blocks of one partial sum of the camera's gradient, the same on any number of threads
  const int64_t n = blocks_for(count), chunks = (n + kChunk - 1) / kChunk;
  std::vector<double> partial(static_cast<size_t>(chunks) * kPoseSums);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
  for (int64_t chunk = 0; chunk < chunks; ++chunk) {
    const FlushDenormals flush;
    for (int64_t b = chunk * kChunk; b < std::min(n, (chunk + 1) * kChunk); ++b) {
      const float* p = blocks + b * kBlockFloats;
      float* g = grad_blocks + b * kBlockFloats;
      for (int r = 0; r < kRows; ++r) store(g + r * kLanes, splat(0.0f));
      Projection o;
      project_geometry(p, cam, o);
      Float color[3];
      shade(p, cam, degree, o, color);
      o.visible &= mask_of(lanes_of(b, count));
      if (!any(o.visible)) continue;

      alignas(64) float lanes[kDifferentiable][kLanes] = {};
      for (uint32_t left = bits(o.visible); left; left &= left - 1) {
        const int l = __builtin_ctz(left);
        const int64_t i = b * kLanes + l;
        for (int f = 0; f < 2; ++f) lanes[kMeanX + f][l] = d.means2d[2 * i + f];
        for (int f = 0; f < 3; ++f) {
          lanes[kConicA + f][l] = d.conics[3 * i + f];
          lanes[kRed + f][l] = d.colors[3 * i + f];
        }
        lanes[kOpacity][l] = d.opacities[i];
        lanes[kDepth][l] = d.depths[i];
      }
      // dL/dSigma' = -C dC C, and C = 2 ln 2 F^T F.
      const Factor f = conic_factor(o.b, o.c, o.det);
      constexpr float k = -4.0f * kLn2 * kLn2;
      const Float da = load(lanes[kConicA]), half_db = load(lanes[kConicB]) * 0.5f, dc = load(lanes[kConicC]);
      const Float row_a = fma(f.ux, da, f.uy * half_db), row_b = fma(f.ux, half_db, f.uy * dc);
      ProjectedGradient to;
      to.x2d = load(lanes[kMeanX]);
      to.y2d = load(lanes[kMeanY]);
      to.Quu = fma(row_a, f.ux, row_b * f.uy) * k;
      to.Quv = row_b * f.vy * k;
      to.Qvv = f.vy * f.vy * dc * k;
      to.logit = load(lanes[kOpacity]) * o.opacity * o.complement;
      for (int c = 0; c < 3; ++c) to.color[c] = load(lanes[kRed + c]);
      to.depth = load(lanes[kDepth]);
      CameraGradient camera;
      project_backward<true>(p, cam, degree, o, to, g, &camera);
      const int rows = kSh + 3 * (degree + 1) * (degree + 1);
      for (int r = 0; r < rows; ++r) store(g + r * kLanes, keep(o.visible, load(g + r * kLanes)));
      add_camera_gradient(camera, o.visible, &partial[static_cast<size_t>(chunk) * kPoseSums]);
    }
  }
  double total[kPoseSums];
  add_parts(partial.data(), chunks, total);
  for (int k = 0; k < kPoseSums; ++k) d_viewmat[k] = static_cast<float>(total[k]);
  for (int k = kPoseSums; k < 16; ++k) d_viewmat[k] = 0.0f;
}

}  // namespace

void bind_project(nb::module_& m) {
  m.def(
      "project",
      [](Blocks blocks, int64_t count, int degree, const Camera& camera, Rows<2> means2d, Rows<3> conics,
         Row opacities, Rows<3> colors, Row depths, Rows<2> extents, int threads) {
        const ProjectedRows out{means2d.data(), conics.data(), opacities.data(), colors.data(), depths.data(), extents.data()};
        nb::gil_scoped_release release;
        project_rows(blocks.data(), count, degree, camera, out, threads);
      },
      "blocks"_a.noconvert(), "count"_a, "degree"_a, "camera"_a, "means2d"_a.noconvert(), "conics"_a.noconvert(),
      "opacities"_a.noconvert(), "colors"_a.noconvert(), "depths"_a.noconvert(), "extents"_a.noconvert(), "threads"_a);
  m.def(
      "project_backward",
      [](Blocks blocks, int64_t count, int degree, const Camera& camera, Rows<2> d_means2d, Rows<3> d_conics,
         Row d_opacities, Rows<3> d_colors, Row d_depths, Blocks grad_blocks, Matrix4 d_viewmat, int threads) {
        const ProjectedRows d{d_means2d.data(), d_conics.data(), d_opacities.data(), d_colors.data(), d_depths.data(), nullptr};
        nb::gil_scoped_release release;
        project_rows_backward(blocks.data(), count, degree, camera, d, grad_blocks.data(), d_viewmat.data(), threads);
      },
      "blocks"_a.noconvert(), "count"_a, "degree"_a, "camera"_a, "d_means2d"_a.noconvert(), "d_conics"_a.noconvert(),
      "d_opacities"_a.noconvert(), "d_colors"_a.noconvert(), "d_depths"_a.noconvert(), "grad_blocks"_a.noconvert(),
      "d_viewmat"_a.noconvert(), "threads"_a);
}

}  // namespace splatmill
