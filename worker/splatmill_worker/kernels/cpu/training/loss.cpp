// SSIM (Wang et al. 2004) needs windowed moments; its gradient needs the same window over three maps of derivatives. Moments are
// those of the difference d = x - p from the photo p, of d^2 and of d p: the variance of x as E[x^2] - E[x]^2 would lose the
// digits that bright, flat parts of a picture are about. With the photo's mean m and variance v, and over one window,
//
//   mean(x) = m + E[d],   c = E[d p] - m E[d],   V = E[d^2] - E[d]^2,   var(x) = v + 2 c + V,   cov(x, p) = v + c,
//   SSIM = l s,   l = 1 - E[d]^2 / B1,   s = 1 - V / B2,   B1 = mean(x)^2 + m^2 + C1,   B2 = var(x) + v + C2.
//
// Both run in one sweep down the image: rows are filtered sideways as they are read, and blocks of four rows are
// filtered downwards out of a ring of sixteen, so that nothing larger than a ring leaves the second cache.
//
//   row      m     moments of d, filtered sideways          -> ring `moments`
//   row      m-5   moments filtered downwards, SSIM, derivatives -> ring `slopes`
//   row      m-10  slopes filtered downwards, then sideways -> gradient
#include "training/loss.hpp"

#include <algorithm>
#include <cmath>

#include "bindings/bindings.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

constexpr int kHalf = 5, kTaps = 2 * kHalf + 1;  // the window
constexpr int kBlock = 4;                        // rows filtered downwards together: 14 loads for 4 results, not 44
constexpr int kRing = 16;                        // rows kept; the window over a block reads 14
constexpr int kMargin = 32;                      // columns left and right of a strip: two windows, in whole vectors
constexpr int kStrip = 1024;                     // widest strip: beyond it the rings, 0.6 KB a column, leave the second cache
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;        // (0.01)^2 and (0.03)^2 for values in 0..1

// exp(-d^2 / (2 * 1.5^2)) for d = 0..5, divided by the sum over all eleven taps.
constexpr float kTap[kHalf + 1] = {0.266011725f,   0.213005538f,   0.10936069f,
                                0.0360007721f, 0.00759875814f, 0.00102838008f};
SPLATMILL_INLINE Float tap(int t) { return splat(kTap[t < kHalf ? kHalf - t : t - kHalf]); }

// Sixteen rows of float, kept by their number modulo sixteen. `width` includes the margins.
class Ring {
 public:
  Ring(float* data, int width) : data_(data), stride_(ring_stride(width)) {}
  float* row(int y) const { return data_ + (y & (kRing - 1)) * stride_; }
  static std::size_t floats(int width) { return static_cast<std::size_t>(kRing) * ring_stride(width); }

 private:
  // An odd number of cache lines: rows a power of two apart would fall into the same few sets of the first cache.
  static int64_t ring_stride(int width) { return (width / kLanes | 1) * kLanes; }
  float* data_;
  int64_t stride_;
};

// Sixteen bytes as floats. GCC 12 takes the bytes apart one by one when the conversion is left to it.
SPLATMILL_INLINE Float load_bytes(const uint8_t* p) {
#if defined(__AVX512F__)
  return {{_mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))))}};
#elif defined(__AVX2__)
  return detail::each<Float>([&](auto i) {
    const __m128i bytes = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(p + i * kNative));
    return _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(bytes));
  });
#elif defined(SPLATMILL_X86)
  const __m128i zero = _mm_setzero_si128(), bytes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(p));
  const __m128i low = _mm_unpacklo_epi8(bytes, zero), high = _mm_unpackhi_epi8(bytes, zero);
  return {{_mm_cvtepi32_ps(_mm_unpacklo_epi16(low, zero)), _mm_cvtepi32_ps(_mm_unpackhi_epi16(low, zero)),
           _mm_cvtepi32_ps(_mm_unpacklo_epi16(high, zero)), _mm_cvtepi32_ps(_mm_unpackhi_epi16(high, zero))}};
#else
  Float x;
  for (int i = 0; i < kLanes; ++i) x.part[i / kNative][i % kNative] = p[i];
  return x;
#endif
}

// The window down `rows`, at column j of each, for four rows at once.
struct Column {
  Float out[kBlock];
};
SPLATMILL_INLINE Column filter_down(const Ring& ring, int y, int j) {
  Column c;
#pragma GCC unroll 4
  for (int o = 0; o < kBlock; ++o) c.out[o] = splat(0.0f);
#pragma GCC unroll 14
  for (int r = 0; r < kBlock + kTaps - 1; ++r) {
    const Float value = load(ring.row(y - kHalf + r) + j);
#pragma GCC unroll 4
    for (int o = 0; o < kBlock; ++o)
      if (r - o >= 0 && r - o < kTaps) c.out[o] = fma(tap(r - o), value, c.out[o]);
  }
  return c;
}

SPLATMILL_INLINE Float filter_across(const float* row, int j) {
  Float sum = splat(0.0f);
#pragma GCC unroll 11
  for (int t = 0; t < kTaps; ++t) sum = fma(tap(t), load_unaligned(row + j + t - kHalf), sum);
  return sum;
}

// Memory for all rings of a strip, carved in order.
struct Rings {
  Ring difference, seen, mean, square, product, slope_mean, slope_square, slope_product;
  Ring lines;  // rows of the three filtered slopes, three times four, for the last sideways pass

  static constexpr int kCount = 9;
  Rings(float* p, int width)
      : difference(p, width), seen(at(p, width, 1), width), mean(at(p, width, 2), width), square(at(p, width, 3), width),
        product(at(p, width, 4), width), slope_mean(at(p, width, 5), width), slope_square(at(p, width, 6), width),
        slope_product(at(p, width, 7), width), lines(at(p, width, 8), width) {}
  static std::size_t floats(int width) { return kCount * Ring::floats(width); }

 private:
  static float* at(float* p, int width, int i) { return p + i * Ring::floats(width); }
};

// One strip of columns [left, right) of one channel. Strip column j is image column left - kMargin + j.
class Strip {
 public:
  Strip(const Planes& color, const Photo& photo, int channel, int left, int right, float* memory)
      : color_(color), photo_(photo), channel_(channel), left_(left), width_(right - left + 2 * kMargin),
        ring_(memory, width_) {}

  // The gradient of rows [top, bottom). Sums of |x - y| and of SSIM over each row are left in absolute[y] and similarity[y].
  void sweep(int top, int bottom, float l1_slope, float ssim_slope, const Planes& gradient, double* absolute,
             double* similarity) {
    for (int m = top - 2 * kHalf; m - 2 * kHalf < bottom; m += kBlock) {
      for (int y = m; y < m + kBlock; ++y) read_row(y);
      // The first block of slopes ends at top - 4 or later. Its rows above top - 5 lack moments; they are never read.
      if (m + kBlock > top) find_slopes(m - kHalf, top, bottom, similarity);
      if (m - 2 * kHalf >= top) write_gradient(m - 2 * kHalf, bottom, l1_slope, ssim_slope, gradient, absolute);
    }
  }

 private:
  int column(int j) const { return left_ - kMargin + j; }
  bool inside(int j) const { return column(j) >= 0 && column(j) < photo_.stride; }
  int64_t offset(int y) const { return (static_cast<int64_t>(channel_) * photo_.height + y) * photo_.stride; }
  Mask used(int y, int j) const { return load_bytes(photo_.used + y * photo_.stride + column(j)) > 0.0f; }

  // Reads row y and filters its moments sideways. Rows and columns outside the image are zeros, and so are pixels not used.
  void read_row(int y) {
    float *d = ring_.difference.row(y), *p = ring_.seen.row(y);
    float *mean = ring_.mean.row(y), *square = ring_.square.row(y), *product = ring_.product.row(y);
    if (y < 0 || y >= photo_.height) {
      for (float* row : {d, p, mean, square, product}) std::fill(row, row + width_, 0.0f);
      return;
    }
    const float* rendered = color_.at(channel_, y);
    const uint8_t* seen = photo_.pixels + offset(y);
    for (int j = 0; j < width_; j += kLanes) {
      const Float photo = inside(j) ? load_bytes(seen + column(j)) * (1.0f / 255.0f) : splat(0.0f);
      store(p + j, photo);
      store(d + j, inside(j) ? keep(used(y, j), load(rendered + column(j)) - photo) : splat(0.0f));
    }
    for (int j = kLanes; j < width_ - kLanes; j += kLanes) {
      Float m = splat(0.0f), s = m, q = m;
#pragma GCC unroll 11
      for (int t = 0; t < kTaps; ++t) {
        const Float a = load_unaligned(d + j + t - kHalf), b = load_unaligned(p + j + t - kHalf);
        const Float weighted = tap(t) * a;
        m = m + weighted;
        s = fma(weighted, a, s);
        q = fma(weighted, b, q);
      }
      store(mean + j, m);
      store(square + j, s);
      store(product + j, q);
    }
  }

  // SSIM of rows y .. y + 3 and its derivatives to the three windowed moments; zero where a pixel does not count.
  void find_slopes(int y, int top, int bottom, double* similarity) {
    Float row_sum[kBlock];
    for (Float& sum : row_sum) sum = splat(0.0f);
    for (int j = kLanes; j < width_ - kLanes; j += kLanes) {
      Column mean, square, product;
      if (inside(j)) {
        mean = filter_down(ring_.mean, y, j);
        square = filter_down(ring_.square, y, j);
        product = filter_down(ring_.product, y, j);
      }
      for (int o = 0; o < kBlock; ++o) {
        Float by_mean = splat(0.0f), by_square = by_mean, by_product = by_mean;
        if (inside(j) && y + o >= 0 && y + o < photo_.height) {
          const int64_t at = offset(y + o) + column(j);
          const Float md = mean.out[o], mu2 = load(photo_.mean + at), variance2 = load(photo_.variance + at), mu1 = mu2 + md;
          // Exactly, a variance is never negative; rounded, it can be, and would let the denominator near zero.
          const Float spread = max(fnma(md, md, square.out[o]), 0.0f), covariance = fnma(md, mu2, product.out[o]);
          const Float variance1 = max(fma(2.0f, covariance, variance2 + spread), 0.0f);
          const Float b1 = fma(mu1, mu1, fma(mu2, mu2, splat(kC1))), b2 = variance1 + variance2 + splat(kC2);
          const Float inverse = reciprocal(b1 * b2), inverse1 = inverse * b2, inverse2 = inverse * b1;
          const Float shift = md * inverse1, part = spread * inverse2;
          const Float light = fnma(md, shift, splat(1.0f)), structure = splat(1.0f) - part, ssim = light * structure;
          const Mask counts = used(y + o, j);
          by_square = keep(counts, -(ssim * inverse2));                             // -S / B2
          by_product = keep(counts, 2.0f * light * part * inverse2);                // 2 l V / B2^2
          const Float direct = structure * shift * fnma(mu1, shift, splat(1.0f));   // -dl/dE[d] s / 2
          by_mean = keep(counts, fnma(splat(2.0f), fma(md, by_square, direct), -(mu2 * by_product)));
          if (j >= kMargin && j < width_ - kMargin) row_sum[o] += keep(counts, ssim);
        }
        store(ring_.slope_mean.row(y + o) + j, by_mean);
        store(ring_.slope_square.row(y + o) + j, by_square);
        store(ring_.slope_product.row(y + o) + j, by_product);
      }
    }
    for (int o = 0; o < kBlock; ++o)
      if (y + o >= top && y + o < bottom) similarity[y + o] = sum(row_sum[o]);
  }

  // Rows y .. y + 3 of d(loss) / dx = l1 sign(d) + ssim (G*slope_mean + 2 d G*slope_square + p G*slope_product).
  void write_gradient(int y, int bottom, float l1_slope, float ssim_slope, const Planes& gradient, double* absolute) {
    const Ring* slopes[3] = {&ring_.slope_mean, &ring_.slope_square, &ring_.slope_product};
    for (int i = 0; i < 3; ++i)
      for (int j = kLanes; j < width_ - kLanes; j += kLanes) {
        const Column c = filter_down(*slopes[i], y, j);
        for (int o = 0; o < kBlock; ++o) store(line(i, o) + j, c.out[o]);
      }
    for (int o = 0; o < kBlock && y + o < bottom; ++o) {
      const float *d = ring_.difference.row(y + o), *p = ring_.seen.row(y + o);
      Float row_sum = splat(0.0f);
      for (int j = kMargin; j < width_ - kMargin; j += kLanes) {
        const Float difference = load(d + j), b = load(p + j);
        const Float sign = select(difference > 0.0f, splat(l1_slope), keep(difference < 0.0f, splat(-l1_slope)));
        const Float similar = fma(2.0f * difference, filter_across(line(1, o), j),
                                  fma(b, filter_across(line(2, o), j), filter_across(line(0, o), j)));
        store(gradient.at(channel_, y + o, column(j)), keep(used(y + o, j), fma(ssim_slope, similar, sign)));
        row_sum += abs(difference);
      }
      absolute[y + o] = sum(row_sum);
    }
  }

  float* line(int map, int o) const { return ring_.lines.row(map * kBlock + o); }

  const Planes& color_;
  const Photo& photo_;
  int channel_, left_, width_;
  Rings ring_;
};

// A photo's planes, and its mean and variance under the window, for rows [top, bottom) of one channel.
class StatsStrip {
 public:
  StatsStrip(const Photo& photo, int channel, float* memory)
      : photo_(photo), channel_(channel), width_(static_cast<int>(photo.stride) + 2 * kLanes), seen_(memory, width_),
        mean_(memory + Ring::floats(width_), width_), variance_(memory + 2 * Ring::floats(width_), width_) {}
  static std::size_t floats(int64_t stride) { return 3 * Ring::floats(static_cast<int>(stride) + 2 * kLanes); }

  void sweep(int top, int bottom, float* mean, float* variance) {
    for (int m = top - kHalf; m - kHalf < bottom; m += kBlock) {
      for (int y = m; y < m + kBlock; ++y) read_row(y);
      // The block that ends kHalf rows above the last one read.
      const int y = m - kHalf;
      if (y + kBlock <= top) continue;
      for (int j = kLanes; j < width_ - kLanes; j += kLanes) {
        // The variance of a window is the mean of its rows' variances and the variance of their means. Both are taken about a
        // centre nearby, so that they have the digits of the contrast and not those of the brightness.
        const Float center = load(mean_.row(y) + j);
        Column first, second;
        for (int o = 0; o < kBlock; ++o) first.out[o] = second.out[o] = splat(0.0f);
#pragma GCC unroll 14
        for (int r = 0; r < kBlock + kTaps - 1; ++r) {
          const Float off = load(mean_.row(y - kHalf + r) + j) - center;
          const Float both = fma(off, off, load(variance_.row(y - kHalf + r) + j));
#pragma GCC unroll 4
          for (int o = 0; o < kBlock; ++o)
            if (r - o >= 0 && r - o < kTaps) {
              first.out[o] = fma(tap(r - o), off, first.out[o]);
              second.out[o] = fma(tap(r - o), both, second.out[o]);
            }
        }
        for (int o = std::max(top - y, 0); o < kBlock && y + o < bottom; ++o) {
          const int64_t at = (static_cast<int64_t>(channel_) * photo_.height + y + o) * photo_.stride + j - kLanes;
          const Mask inside = iota() < static_cast<float>(photo_.width - (j - kLanes));
          store(mean + at, keep(inside, center + first.out[o]));
          store(variance + at, keep(inside, max(fnma(first.out[o], first.out[o], second.out[o]), 0.0f)));
        }
      }
    }
  }

 private:
  void read_row(int y) {
    float *p = seen_.row(y), *mean = mean_.row(y), *variance = variance_.row(y);
    if (y < 0 || y >= photo_.height) {
      for (float* row : {p, mean, variance}) std::fill(row, row + width_, 0.0f);
      return;
    }
    const uint8_t* seen = photo_.pixels + (static_cast<int64_t>(channel_) * photo_.height + y) * photo_.stride;
    store(p, splat(0.0f));
    store(p + width_ - kLanes, splat(0.0f));
    for (int j = kLanes; j < width_ - kLanes; j += kLanes) store(p + j, load_bytes(seen + j - kLanes) * (1.0f / 255.0f));
    for (int j = kLanes; j < width_ - kLanes; j += kLanes) {
      const Float middle = load(p + j);
      Float m = splat(0.0f), s = m;
#pragma GCC unroll 11
      for (int t = 0; t < kTaps; ++t) {
        const Float off = load_unaligned(p + j + t - kHalf) - middle, weighted = tap(t) * off;
        m = m + weighted;
        s = fma(weighted, off, s);
      }
      store(mean + j, middle + m);
      store(variance + j, fnma(m, m, s));
    }
  }

  const Photo& photo_;
  int channel_, width_;
  Ring seen_, mean_, variance_;  // the photo, and the mean and variance of the window's eleven pixels along its row
};

struct Band {
  int first, last;
};
Band band(int i, int bands, int height) { return {height * i / bands, height * (i + 1) / bands}; }

}  // namespace

LossValue loss(const Planes& color, const Photo& photo, float dssim_weight, const Planes& gradient, LossScratch& scratch,
               int threads) {
  LossValue value;
  const int height = photo.height;
  for (int c = 0; c < 3; ++c)
    std::fill(gradient.at(c, photo.count > 0 ? height : 0), gradient.at(c, padded(height)), 0.0f);
  if (!(photo.count > 0)) return value;

  const int vectors = static_cast<int>(photo.stride / kLanes), strips = (vectors * kLanes + kStrip - 1) / kStrip;
  const int widest = (vectors + strips - 1) / strips * kLanes;
  const std::size_t floats = Rings::floats(widest + 2 * kMargin);
  float* lines = scratch.lines.reserve(static_cast<int64_t>(floats) * threads);
  // The sums of every row are kept and added in order at the end, so that they do not depend on the number of threads.
  const std::size_t rows = static_cast<std::size_t>(3) * strips * height;
  double* sums = scratch.sums.reserve(static_cast<int64_t>(2 * rows));
  const double each = 1.0 / (3 * photo.count);
  const float l1_slope = static_cast<float>((1 - dssim_weight) * each), ssim_slope = static_cast<float>(-dssim_weight * each);
  const int bands = std::max(1, std::min(threads, height / 32));
#pragma omp parallel num_threads(threads)
  {
    FlushDenormals flush;
    float* mine = lines + floats * static_cast<std::size_t>(omp_get_thread_num());
#pragma omp for collapse(3) schedule(static)
    for (int c = 0; c < 3; ++c)
      for (int s = 0; s < strips; ++s)
        for (int b = 0; b < bands; ++b) {
          Strip strip(color, photo, c, vectors * s / strips * kLanes, vectors * (s + 1) / strips * kLanes, mine);
          const Band part = band(b, bands, height);
          double* row = sums + (static_cast<std::size_t>(c) * strips + s) * height;
          strip.sweep(part.first, part.last, l1_slope, ssim_slope, gradient, row, row + rows);
        }
  }
  double absolute = 0, similarity = 0;
  for (std::size_t i = 0; i < rows; ++i) absolute += sums[i], similarity += sums[rows + i];
  value.l1 = absolute * each;
  value.ssim = similarity * each;
  return value;
}

// Fills the planes of a photo (see Photo) from interleaved bytes [height, width, 3] and a mask, or none.
double photo_stats(const uint8_t* photo, const uint8_t* mask, int width, int height, int64_t stride, uint8_t* pixels,
                   uint8_t* used, float* mean, float* variance, int threads) {
  const int64_t plane = stride * height;
  int64_t count = 0;
  const Photo view{pixels, mean, variance, used, width, height, stride, 0};
  const std::size_t floats = StatsStrip::floats(stride);
  Buffer<float> scratch;
  float* lines = scratch.reserve(static_cast<int64_t>(floats) * threads);
  const int bands = std::max(1, std::min(threads, height / 32));
#pragma omp parallel num_threads(threads) reduction(+ : count)
  {
    FlushDenormals flush;
#pragma omp for schedule(static)
    for (int y = 0; y < height; ++y) {
      uint8_t* in_use = used + y * stride;
      for (int x = 0; x < stride; ++x) {
        in_use[x] = x < width && (!mask || mask[static_cast<int64_t>(y) * width + x] != 0);
        count += in_use[x];
        for (int c = 0; c < 3; ++c)
          pixels[c * plane + y * stride + x] = in_use[x] ? photo[(static_cast<int64_t>(y) * width + x) * 3 + c] : 0;
      }
    }
#pragma omp for collapse(2) schedule(static)
    for (int c = 0; c < 3; ++c)
      for (int b = 0; b < bands; ++b) {
        const Band part = band(b, bands, height);
        StatsStrip strip(view, c, lines + floats * static_cast<std::size_t>(omp_get_thread_num()));
        strip.sweep(part.first, part.last, mean, variance);
      }
  }
  return static_cast<double>(count);
}

void bind_loss(nb::module_& m) {
  using Image = Tensor<float, nb::shape<3, -1, -1>>;        // planes padded to whole tiles
  using Bytes3 = Tensor<uint8_t, nb::shape<3, -1, -1>>;     // [3, height, stride]
  using Floats3 = Tensor<float, nb::shape<3, -1, -1>>;      // [3, height, stride]
  using Bytes2 = Tensor<uint8_t, nb::shape<-1, -1>>;        // [height, stride]
  m.def(
      "photo_stats",
      [](Tensor<const uint8_t, nb::shape<-1, -1, 3>> photo, std::optional<Tensor<const uint8_t, nb::shape<-1, -1>>> mask,
         Bytes3 pixels, Bytes2 used, Floats3 mean, Floats3 variance, int threads) {
        nb::gil_scoped_release release;
        return photo_stats(photo.data(), mask ? mask->data() : nullptr, static_cast<int>(photo.shape(1)),
                           static_cast<int>(photo.shape(0)), static_cast<int64_t>(pixels.shape(2)), pixels.data(),
                           used.data(), mean.data(), variance.data(), threads > 0 ? threads : default_threads());
      },
      nb::arg("photo").noconvert(), nb::arg("mask").noconvert().none(), nb::arg("pixels").noconvert(),
      nb::arg("used").noconvert(), nb::arg("mean").noconvert(), nb::arg("variance").noconvert(), nb::arg("threads") = 0,
      "Fill a photo's planes and SSIM statistics; returns how many pixels count.");
  m.def(
      "loss",
      [](Image color, Bytes3 pixels, Bytes2 used, Floats3 mean, Floats3 variance, int width, int height, double count,
         double dssim_weight, Image gradient, int threads) {
        const auto stride = static_cast<int64_t>(color.shape(2)), plane = stride * static_cast<int64_t>(color.shape(1));
        const Planes rendered{color.data(), width, height, stride, plane};
        const Planes slope{gradient.data(), width, height, stride, plane};
        const Photo photo{pixels.data(), mean.data(), variance.data(), used.data(), width, height, stride, count};
        static thread_local LossScratch scratch;
        nb::gil_scoped_release release;
        const LossValue value = loss(rendered, photo, static_cast<float>(dssim_weight), slope, scratch,
                                     threads > 0 ? threads : default_threads());
        return std::make_tuple(value.l1, value.ssim);
      },
      nb::arg("color").noconvert(), nb::arg("pixels").noconvert(), nb::arg("used").noconvert(),
      nb::arg("mean").noconvert(), nb::arg("variance").noconvert(), nb::arg("width"), nb::arg("height"), nb::arg("count"),
      nb::arg("dssim_weight"), nb::arg("gradient").noconvert(), nb::arg("threads") = 0,
      "Mean |difference| and mean SSIM; writes the gradient of (1 - w) L1 + w (1 - SSIM).");
}

}  // namespace splatmill
