// The fused training step. `render` projects, bins and composites a view. `update` takes the gradient of its image and makes one
// pass over the blocks of sixteen Gaussians: it adds up their pair sums, differentiates the projection and applies Adam, so that
// a Gaussian's gradient never leaves the first-level cache.
#include "bindings/arguments.hpp"
#include "compositing/composite.hpp"
#include "compositing/waves.hpp"
#include "projection/geometry.hpp"
#include "projection/pose.hpp"
#include "projection/project.hpp"
#include "simd/shuffles.hpp"
#include "simd/threads.hpp"
#include "tiles/bin.hpp"
#include "training/adam.hpp"
#include "training/clusters.hpp"

namespace splatmill {
namespace {

// Rows of the densification scores [kScoreRows][Gaussians].
enum Score {
  kPlain,   // sum over views of |dL/d mean2d|, in NDC units
  kSeen,    // views in which the Gaussian was visible
  kExtent,  // largest half side of the ellipse's box, over half the longer side of the whole photo
  kScoreRows
};

// Parameters of a Gaussian that are used at a degree of the spherical harmonics.
SPLATMILL_INLINE int rows_of(int degree) { return kSh + 3 * (degree + 1) * (degree + 1); }

struct Scene {
  const float* params;
  int degree;
};

// What the pass over blocks writes: moved parameters and moments, or the gradients alone.
struct Update {
  State state;
  float rates[kRows] = {};  // with the bias correction of the first moment
  AdamStep adam;            // weights and bias correction of the second moment; its `size` is in `rates` already
  float* gradients = nullptr;
  float* scores = nullptr;  // [kScoreRows][score_stride]; null where none are kept
  int64_t score_stride = 0;
  float photo_width = 0, photo_height = 0;  // of the whole photo that scores refer to, pixels
};

// Adds up the pair sums of a block in the order of the pairs: lane l of sums[k] is sum k of Gaussian l.
SPLATMILL_INLINE void add_pairs(const Frame& frame, int64_t b, uint32_t visible, Float* sums) {
  for (int l = 0; l < kLanes; ++l) sums[l] = splat(0.0f);
  for (uint32_t left = visible; left; left &= left - 1) {
    const int l = __builtin_ctz(left);
    const Span span = frame.spans[b * kLanes + l];
    Float total = splat(0.0f);
    for (uint32_t k = span.first; k < span.first + span.count; ++k)
      if (frame.touches[k].blocks) total += load(&frame.pair_sums[static_cast<int64_t>(k) * kPairSums]);
    sums[l] = total;
  }
  transpose(sums);
}

// Sums over (u, v) to gradients of the projected Gaussian. With e = log2 alpha = level - u^2 - v^2 and q = alpha dL/dalpha,
// dL/de = q ln 2; the conic applied to the offset is 2 ln 2 (ux u, uy u + vy v), and dL/dSigma' = q/2 times its outer square.
SPLATMILL_INLINE ProjectedGradient gradient_from_sums(const Float* s, const Projection& o) {
  const Factor f = conic_factor(o.b, o.c, o.det);
  const Float uu = s[kSumQUU], uv = s[kSumQUV], vv = s[kSumQVV];
  constexpr float k1 = 2.0f * kLn2, k2 = 2.0f * kLn2 * kLn2;
  ProjectedGradient d;
  d.x2d = f.ux * s[kSumQU] * k1;
  d.y2d = fma(f.uy, s[kSumQU], f.vy * s[kSumQV]) * k1;
  d.Quu = uu * k2;
  d.Quv = uv * k2;
  d.Qvv = vv * k2;
  d.logit = s[kSumQ] * o.complement;
  for (int c = 0; c < 3; ++c) d.color[c] = s[kSumRed + c];
  d.depth = s[kSumDepth];
  return d;
}

SPLATMILL_INLINE void add_scores(const Update& update, int64_t b, const Projection& o, const ProjectedGradient& d, Mask visible) {
  const float half_w = 0.5f * update.photo_width, half_h = 0.5f * update.photo_height;
  const auto length = [&](Float x, Float y) {
    x = x * half_w, y = y * half_h;
    return sqrt(fma(x, x, y * y));
  };
  float* score = update.scores + b * kLanes;
  const auto at = [&](Score k) { return score + k * update.score_stride; };
  store(at(kPlain), visible, load(at(kPlain)) + length(d.x2d, d.y2d));
  store(at(kSeen), visible, load(at(kSeen)) + 1.0f);
  const float per_image = 2.0f / std::max(update.photo_width, update.photo_height);
  store(at(kExtent), visible, max(max(o.extent_x, o.extent_y) * per_image, load(at(kExtent))));
}

// Updates one block; returns how many gradient values Adam refused. With kPose, adds the camera's gradient to `pose`.
template <bool kAdam, bool kPose>
int64_t update_block(const Frame& frame, const ImageGradient& g, const Scene& scene, const Update& update, int64_t b,
                     double* pose) {
  const int rows = rows_of(scene.degree);
  const float* p = scene.params + b * kBlockFloats;
  const uint32_t seen = frame.visible[b];
  const Mask visible = mask_of(seen);
  alignas(64) float gradient[kBlockFloats];
  if (seen) {
    Float sums[kLanes];
    add_pairs(frame, b, seen, sums);
    if (!g.with_alpha_and_depth) sums[kSumDepth] = splat(0.0f);  // that pass does not write it: memory holds garbage
    Projection o;
    project_geometry(p, frame.camera, o);
    const ProjectedGradient d = gradient_from_sums(sums, o);
    if (update.scores) add_scores(update, b, o, d, visible);
    CameraGradient camera;
    project_backward<kPose>(p, frame.camera, scene.degree, o, d, gradient, &camera);
    if constexpr (kPose) add_camera_gradient(camera, visible, pose);
  }
  if constexpr (!kAdam) {
    float* out = update.gradients + b * kBlockFloats;
    for (int r = 0; r < kRows; ++r)
      store(out + r * kLanes, seen && r < rows ? keep(visible, load(gradient + r * kLanes)) : splat(0.0f));
    return 0;
  } else {
    int64_t refused = 0;
    const BlockState at(update.state, b);
    for (int r = 0; r < rows; ++r) {
      Float x, m, v;
      at.load(r, x, m, v);
      const Float slope = seen ? keep(visible, load(gradient + r * kLanes)) : splat(0.0f);
      const Mask good = adam_update(x, m, v, slope, splat(update.rates[r]), update.adam);
      refused += kLanes - __builtin_popcount(bits(good));
      at.store(r, x, m, v);
    }
    return refused;
  }
}

// Updates the blocks before `end`, or with `clusters` those of the chosen ones, of which one task updates one and adds up its camera
// gradients.
// With kPose, writes the sums [kPoseSums] of the camera's gradient to `pose`.
template <bool kAdam, bool kPose>
int64_t update_scene(Frame& frame, const ImageGradient& g, const Scene& scene, const Update& update, double* pose, int threads,
                     int64_t end, Clusters* clusters = nullptr) {
  const Visited visited(frame.count, clusters);
  const int64_t n = visited.blocks(), chunks = (n + kClusterBlocks - 1) / kClusterBlocks;
  double* partial = kPose ? frame.pose_sums.reserve(chunks * kPoseSums) : nullptr;
  int64_t refused = 0;
#pragma omp parallel num_threads(threads) reduction(+ : refused)
  {
    const FlushDenormals flush;
#pragma omp for schedule(dynamic, 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      double* sums = kPose ? partial + chunk * kPoseSums : nullptr;
      if constexpr (kPose) std::fill_n(sums, kPoseSums, 0.0);
      for (int64_t i = chunk * kClusterBlocks; i < std::min(n, (chunk + 1) * kClusterBlocks); ++i)
        if (visited.block(i) < end) refused += update_block<kAdam, kPose>(frame, g, scene, update, visited.block(i), sums);
      if (clusters) clusters->moved(update.state, clusters->chosen()[chunk]);
    }
  }
  if constexpr (kPose) add_parts(partial, chunks, pose);
  return refused;
}

using ScoreRows = Tensor<float, nb::shape<kScoreRows, -1>>;
using Twist = Tensor<float, nb::shape<6>>;

class Stopwatch {
 public:
  // Wall seconds since the last lap, or since the start.
  double lap() {
    const double now = omp_get_wtime(), passed = now - last_;
    last_ = now;
    return passed;
  }

 private:
  double last_ = omp_get_wtime();
};

}  // namespace

void bind_step(nb::module_& m) {
  m.def(
      "render",
      [](Frame& frame, Blocks params, int64_t count, int degree, const Camera& camera,
         const std::tuple<float, float, float>& background, Image image, int threads, const Clusters* clusters,
         std::optional<Rows<kWaveFloats>> waves, std::optional<WaveRows> wave_rows) {
        const float rgb[3] = {std::get<0>(background), std::get<1>(background), std::get<2>(background)};
        const bool with_alpha_and_depth = image.shape(0) == 5;
        nb::gil_scoped_release release;
        frame.camera = camera;
        Stopwatch watch;
        project_frame(params.data(), count, degree, frame, threads, clusters);
        frame.seconds.project = watch.lap();
        bin_frame(frame, threads);
        frame.seconds.bin = watch.lap();
        frame.with_waves = waves && wave_rows;
        if (frame.with_waves)
          take_waves(frame, waves->data(), static_cast<int64_t>(waves->shape(0)), wave_rows->data(), count);
        composite_forward(frame, planes_of(image, camera), with_alpha_and_depth, rgb, threads);
        frame.seconds.forward = watch.lap();
        return std::make_tuple(frame.visible_count, frame.pairs);
      },
      "frame"_a, "params"_a.noconvert(), "count"_a, "degree"_a, "camera"_a, "background"_a, "image"_a.noconvert(), "threads"_a,
      "clusters"_a.none() = nb::none(), "waves"_a.noconvert().none() = nb::none(), "wave_rows"_a.noconvert().none() = nb::none(),
      "Renders blocks of parameters into three planes of colour or, with alpha and depth, five planes; returns the numbers of "
      "visible Gaussians and of (tile, Gaussian) pairs. With `clusters`, the others than those chosen last are taken to be out of view.");
  m.def(
      "update",
      [](Frame& frame, Blocks params, Blocks exp_avg, Blocks exp_avg_sq, int degree, Image image, Image gradient,
         const std::vector<float>& rates, double beta2, int64_t step, std::optional<ScoreRows> scores, int threads,
         std::optional<Twist> pose, Clusters* clusters, std::optional<Rows<kWaveFloats>> d_waves, std::optional<int64_t> moved,
         std::optional<std::tuple<int, int>> photo) {
        Update update;
        update.state = {params.data(), exp_avg.data(), exp_avg_sq.data()};
        update.adam = AdamStep(step, beta2);
        for (int r = 0; r < kRows; ++r) update.rates[r] = rates.at(r) * update.adam.size;
        const ImageGradient g{planes_of(image, frame.camera), planes_of(gradient, frame.camera), gradient.shape(0) == 5};
        if (scores) update.scores = scores->data(), update.score_stride = static_cast<int64_t>(scores->shape(1));
        const auto [width, height] = photo.value_or(std::tuple(frame.camera.width, frame.camera.height));
        update.photo_width = static_cast<float>(width), update.photo_height = static_cast<float>(height);
        nb::gil_scoped_release release;
        Stopwatch watch;
        composite_backward(frame, g, threads);
        if (d_waves) gradients_of_waves(frame, frame.visible.get(), d_waves->data(), threads);
        frame.seconds.backward = watch.lap();
        const Scene scene{params.data(), degree};
        if (clusters) {
          Drift::Sums by_group;
          for (int rate = 0; rate < kRates; ++rate) by_group[rate] = rates.at(kRateRows[rate]);
          clusters->advance(update.state, by_group, step, beta2, rows_of(degree), threads);
        }
        const int64_t end = moved.value_or(blocks_for(frame.count));
        int64_t refused;
        if (pose) {
          double sums[kPoseSums];
          refused = update_scene<true, true>(frame, g, scene, update, sums, threads, end, clusters);
          motion_gradient(frame.camera, sums, pose->data());
        } else {
          refused = update_scene<true, false>(frame, g, scene, update, nullptr, threads, end, clusters);
        }
        frame.seconds.update = watch.lap();
        return refused;
      },
      "frame"_a, "params"_a.noconvert(), "exp_avg"_a.noconvert(), "exp_avg_sq"_a.noconvert(), "degree"_a,
      "image"_a.noconvert(), "gradient"_a.noconvert(), "rates"_a, "beta2"_a, "step"_a,
      "scores"_a.noconvert().none(), "threads"_a, "pose"_a.noconvert().none() = nb::none(), "clusters"_a.none() = nb::none(),
      "d_waves"_a.noconvert().none() = nb::none(), "moved"_a.none() = nb::none(),
      "photo"_a.none() = nb::none(),
      "Backward pass of the last render and one Adam step; returns how many gradient values were refused as not finite. Adds to "
      "`scores` [3, Gaussians] and fills `pose` [6] with the gradient to a motion of the camera (pose.hpp), where given. With "
      "`clusters`, which `render` was given too, moves those chosen last. With `moved`, only blocks before that number are moved. "
      "`photo` is the width and height of the whole photo that the image is a part of, which scores refer to.");
  m.def(
      "gradients",
      [](Frame& frame, Blocks params, int degree, Image image, Image gradient, Blocks gradients, int threads) {
        Update update;
        update.gradients = gradients.data();
        const ImageGradient g{planes_of(image, frame.camera), planes_of(gradient, frame.camera), gradient.shape(0) == 5};
        nb::gil_scoped_release release;
        composite_backward(frame, g, threads);
        update_scene<false, false>(frame, g, {params.data(), degree}, update, nullptr, threads, blocks_for(frame.count));
      },
      "frame"_a, "params"_a.noconvert(), "degree"_a, "image"_a.noconvert(), "gradient"_a.noconvert(), "gradients"_a.noconvert(),
      "threads"_a, "Backward pass of the last render; writes the gradients to the parameters into blocks.");
}

}  // namespace splatmill
