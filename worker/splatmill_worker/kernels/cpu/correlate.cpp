// Normalised cross-correlation of patches with another image, at many depths: sixteen depths of a patch at a time.
#include <algorithm>
#include <vector>

#include "bindings/bindings.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

constexpr float kLeastDepth = 1e-6f;  // as in reference/correlate.py

struct Search {
  const float* image;  // [height, width]
  int width, height;
  const float* inverse;  // [depths]
  int64_t depths;
  float turn[9], shift[3];
  float margin, least_variance;
};

struct Position {
  Float x, y, z;
};

// Where a turned ray is seen at sixteen inverse depths: pixels, and the depth in units of the patch's.
SPLATMILL_INLINE Position seen_at(const float* ray, Float inverse, const Search& s) {
  const Float z = fma(s.shift[2], inverse, splat(ray[2]));
  const Float scale = 1.0f / max(z, kLeastDepth);
  return {fma(s.shift[0], inverse, splat(ray[0])) * scale, fma(s.shift[1], inverse, splat(ray[1])) * scale, z};
}

// The image between its pixels, and its border beyond. A position that is NaN counts as 0.
SPLATMILL_INLINE Float bilinear(const Search& s, Float x, Float y) {
  const Float column = min(max(x - 0.5f, 0.0f), static_cast<float>(s.width - 1));
  const Float row = min(max(y - 0.5f, 0.0f), static_cast<float>(s.height - 1));
  const Float left = min(floor(column), static_cast<float>(s.width - 2));
  const Float top = min(floor(row), static_cast<float>(s.height - 2));
  const Int at = to_int(top) * s.width + to_int(left);
  alignas(64) float a[kLanes], b[kLanes], c[kLanes], d[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const float* p = s.image + at.part[lane / kNative][lane % kNative];
    a[lane] = p[0], b[lane] = p[1], c[lane] = p[s.width], d[lane] = p[s.width + 1];
  }
  const Float u = column - left, v = row - top;
  const Float upper = fma(u, load(b) - load(a), load(a)), lower = fma(u, load(d) - load(c), load(c));
  return fma(v, lower - upper, upper);
}

// turned: the rays of a patch of m points in the other camera; scores [depths].
void correlate_patch(const Search& s, const float* turned, const float* patch, int64_t m, float* scores) {
  const float* middle = turned + 3 * (m / 2);
  const Float right = splat(static_cast<float>(s.width) - s.margin), bottom = splat(static_cast<float>(s.height) - s.margin);
  const float share = 1.0f / static_cast<float>(m);
  for (int64_t first = 0; first < s.depths; first += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(kLanes, s.depths - first));
    const Float inverse = load_first(s.inverse + first, count);
    const Position centre = seen_at(middle, inverse, s);
    const Mask shown = (centre.z > kLeastDepth) & (centre.x > s.margin) & (centre.x < right) & (centre.y > s.margin) &
                       (centre.y < bottom);
    if (!any(shown)) {
      store_first(scores + first, splat(-1.0f), count);
      continue;
    }
    // Grey values count from that of the centre: their variance is what is left of their squares, and would lose its digits.
    const Float origin = bilinear(s, centre.x, centre.y);
    Float sum = splat(0.0f), squares = splat(0.0f), product = splat(0.0f);
    for (int64_t j = 0; j < m; ++j) {
      const Position position = seen_at(turned + 3 * j, inverse, s);
      const Float grey = bilinear(s, position.x, position.y) - origin;
      sum += grey;
      squares = fma(grey, grey, squares);
      product = fma(patch[j], grey, product);
    }
    const Float mean = sum * share;
    const Float variance = max(fnma(mean, mean, squares * share), s.least_variance);
    const Float score = product / sqrt(variance * static_cast<float>(m));
    store_first(scores + first, select(shown, score, splat(-1.0f)), count);
  }
}

}  // namespace

void correlate(const Search& s, const float* rays, const float* patches, int64_t n, int64_t m, float* scores, int threads) {
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
    std::vector<float> turned(static_cast<std::size_t>(3 * m));
#pragma omp for schedule(dynamic, 16)
    for (int64_t i = 0; i < n; ++i) {
      for (int64_t j = 0; j < m; ++j) {
        const float* ray = rays + 3 * (i * m + j);
        for (int a = 0; a < 3; ++a)
          turned[3 * j + a] = s.turn[3 * a] * ray[0] + s.turn[3 * a + 1] * ray[1] + s.turn[3 * a + 2] * ray[2];
      }
      correlate_patch(s, turned.data(), patches + i * m, m, scores + i * s.depths);
    }
  }
}

void bind_correlate(nb::module_& m) {
  m.def(
      "correlate",
      [](Tensor<const float, nb::ndim<2>> image, Tensor<const float, nb::shape<-1, -1, 3>> rays,
         Tensor<const float, nb::ndim<2>> patches, Tensor<const float, nb::ndim<1>> inverse,
         Tensor<const float, nb::shape<3, 3>> turn, Tensor<const float, nb::shape<3>> shift, float margin,
         float least_variance, Tensor<float, nb::ndim<2>> scores, int threads) {
        Search s{};
        s.image = image.data(), s.height = static_cast<int>(image.shape(0)), s.width = static_cast<int>(image.shape(1));
        s.inverse = inverse.data(), s.depths = static_cast<int64_t>(inverse.shape(0));
        std::copy_n(turn.data(), 9, s.turn);
        std::copy_n(shift.data(), 3, s.shift);
        s.margin = margin, s.least_variance = least_variance;
        nb::gil_scoped_release release;
        correlate(s, rays.data(), patches.data(), static_cast<int64_t>(rays.shape(0)), static_cast<int64_t>(rays.shape(1)),
                  scores.data(), threads > 0 ? threads : default_threads());
      },
      nb::arg("image").noconvert(), nb::arg("rays").noconvert(), nb::arg("patches").noconvert(),
      nb::arg("inverse_depths").noconvert(), nb::arg("turn").noconvert(), nb::arg("shift").noconvert(), nb::arg("margin"),
      nb::arg("least_variance"), nb::arg("scores").noconvert(), nb::arg("threads") = 0,
      "Correlation of each patch with the image at each depth, written to scores.");
}

}  // namespace splatmill
