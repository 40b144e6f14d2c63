// The narrow formats that `bench precision` compares with float32, and the aliases that put them in its place: see
// kernels/cpu/layout/storage.hpp, which includes this file where SPLATMILL_STORAGE names it.
#pragma once

namespace splatmill {

#if defined(__AVX512F__)
SPLATMILL_INLINE Int load_u16(const char* p) {
  return {{reinterpret_cast<NativeInt>(_mm512_cvtepu16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p))))}};
}
SPLATMILL_INLINE Int load_u8(const char* p) {
  return {{reinterpret_cast<NativeInt>(_mm512_cvtepu8_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))))}};
}
// The low 16, or the low 8, bits of each lane.
SPLATMILL_INLINE void store_u16(char* p, Int x) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm512_cvtepi32_epi16(reinterpret_cast<__m512i>(x.part[0])));
}
SPLATMILL_INLINE void store_u8(char* p, Int x) {
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p), _mm512_cvtepi32_epi8(reinterpret_cast<__m512i>(x.part[0])));
}
#elif defined(__AVX2__)
SPLATMILL_INLINE Int load_u16(const char* p) {
  return detail::each<Int>([&](auto i) {
    return reinterpret_cast<NativeInt>(_mm256_cvtepu16_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p) + i)));
  });
}
SPLATMILL_INLINE Int load_u8(const char* p) {
  return detail::each<Int>([&](auto i) {
    return reinterpret_cast<NativeInt>(_mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(p + 8 * i))));
  });
}
SPLATMILL_INLINE __m256i packed_u16(Int x) {
  const Int low = x & 0xFFFF;  // packus saturates
  const __m256i both = _mm256_packus_epi32(reinterpret_cast<__m256i>(low.part[0]), reinterpret_cast<__m256i>(low.part[1]));
  return _mm256_permute4x64_epi64(both, 0xD8);
}
SPLATMILL_INLINE void store_u16(char* p, Int x) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), packed_u16(x)); }
SPLATMILL_INLINE void store_u8(char* p, Int x) {
  const __m256i both = packed_u16(x & 0xFF);
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p), _mm_packus_epi16(_mm256_castsi256_si128(both), _mm256_extracti128_si256(both, 1)));
}
#else
template <class Narrow>
SPLATMILL_INLINE Int load_narrow(const char* p) {
  Narrow narrow[kLanes];
  std::memcpy(narrow, p, sizeof narrow);
  Int x;
  for (int i = 0; i < kLanes; ++i) x.part[i / kNative][i % kNative] = narrow[i];
  return x;
}
template <class Narrow>
SPLATMILL_INLINE void store_narrow(char* p, Int x) {
  Narrow narrow[kLanes];
  for (int i = 0; i < kLanes; ++i) narrow[i] = static_cast<Narrow>(x.part[i / kNative][i % kNative]);
  std::memcpy(p, narrow, sizeof narrow);
}
SPLATMILL_INLINE Int load_u16(const char* p) { return load_narrow<uint16_t>(p); }
SPLATMILL_INLINE Int load_u8(const char* p) { return load_narrow<uint8_t>(p); }
SPLATMILL_INLINE void store_u16(char* p, Int x) { store_narrow<uint16_t>(p, x); }
SPLATMILL_INLINE void store_u8(char* p, Int x) { store_narrow<uint8_t>(p, x); }
#endif

// Random bits by step, block and lane, so that results do not depend on the number of threads: xorshift32 (Marsaglia 2003) from
// a hash of the three.
class Noise {
 public:
  SPLATMILL_INLINE Noise(int64_t step, int64_t block) {
    uint64_t h = static_cast<uint64_t>(step) * 0x9E3779B97F4A7C15u + static_cast<uint64_t>(block) * 0xBF58476D1CE4E5B9u;
    alignas(64) int32_t lanes[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      uint64_t x = h += 0x9E3779B97F4A7C15u;  // splitmix64
      x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9u;
      x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
      lanes[l] = static_cast<int32_t>(x >> 32) | 1;
    }
    std::memcpy(&state_, lanes, sizeof state_);
  }
  SPLATMILL_INLINE Int next() {
    state_ = exclusive(state_, state_ << splat(13));
    state_ = exclusive(state_, (state_ >> splat(17)) & 0x7FFF);
    return state_ = exclusive(state_, state_ << splat(5));
  }

 private:
  SPLATMILL_INLINE static Int exclusive(Int a, Int b) {
    return detail::each<Int>([&](auto i) { return a.part[i] ^ b.part[i]; });
  }
  Int state_;
};

// The upper half of a float32, rounded to nearest, ties to even.
struct BFloat16 {
  static constexpr int kBytes = 2;
  SPLATMILL_INLINE static Float load(const char* p) { return as_float(load_u16(p) << splat(16)); }
  template <class Noise>
  SPLATMILL_INLINE static void store(char* p, Float x, Noise& /*noise*/) {
    const Int bits = as_int(x);
    store_u16(p, (bits + (((bits >> splat(16)) & 1) + splat(0x7FFF))) >> splat(16));
  }
};

// Rounded up with the probability of the part that is cut off: the mean of what is stored is what was to be stored.
struct BFloat16Stochastic : BFloat16 {
  template <class Noise>
  SPLATMILL_INLINE static void store(char* p, Float x, Noise& noise) {
    store_u16(p, (as_int(x) + (noise.next() & 0xFFFF)) >> splat(16));
  }
};

// A bfloat16 and the first eight bits of its rounding error.
struct BFloat16Compensated {
  static constexpr int kBytes = 3;
  SPLATMILL_INLINE static Float load(const char* p) {
    return as_float((load_u16(p) << splat(16)) | (load_u8(p + 2 * kLanes) << splat(8)));
  }
  template <class Noise>
  SPLATMILL_INLINE static void store(char* p, Float x, Noise& /*noise*/) {
    const Int bits = as_int(x) + 0x80;
    store_u16(p, bits >> splat(16));
    store_u8(p + 2 * kLanes, bits >> splat(8));
  }
};

// IEEE binary16, rounded to nearest.
struct Float16 {
  static constexpr int kBytes = 2;
  SPLATMILL_INLINE static Float load(const char* p) {
#if defined(__AVX512F__)
    return {{reinterpret_cast<NativeFloat>(_mm512_cvtph_ps(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p))))}};
#elif defined(__F16C__) && defined(__AVX2__)
    return detail::each<Float>([&](auto i) { return _mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p) + i)); });
#else
    _Float16 narrow[kLanes];
    std::memcpy(narrow, p, sizeof narrow);
    alignas(64) float wide[kLanes];
    for (int i = 0; i < kLanes; ++i) wide[i] = static_cast<float>(narrow[i]);
    return splatmill::load(wide);
#endif
  }
  template <class Noise>
  SPLATMILL_INLINE static void store(char* p, Float x, Noise& /*noise*/) {
#if defined(__AVX512F__)
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm512_cvtps_ph(reinterpret_cast<__m512>(x.part[0]), _MM_FROUND_TO_NEAREST_INT));
#elif defined(__F16C__) && defined(__AVX2__)
    for (int i = 0; i < kParts; ++i)
      _mm_storeu_si128(reinterpret_cast<__m128i*>(p) + i, _mm256_cvtps_ph(x.part[i], _MM_FROUND_TO_NEAREST_INT));
#else
    alignas(64) float wide[kLanes];
    splatmill::store(wide, x);
    _Float16 narrow[kLanes];
    for (int i = 0; i < kLanes; ++i) narrow[i] = static_cast<_Float16>(wide[i]);
    std::memcpy(p, narrow, sizeof narrow);
#endif
  }
};

// Unbiased for the normal numbers of binary16; below 6e-5 its steps, 6e-8, are rounded to nearest.
struct Float16Stochastic : Float16 {
  template <class Noise>
  SPLATMILL_INLINE static void store(char* p, Float x, Noise& noise) {
    const Int added = as_int(x) + (noise.next() & 0x1FFF);
    Float16::store(p, as_float(added & ~0x1FFF), noise);
  }
};

// Half a cache line: the centre in float32, since a pixel coordinate needs its digits, and what compositing reads besides it in
// twelve narrow numbers. The op chain's other fields follow from them.
template <class Format>
struct alignas(32) NarrowRecord {
  float x, y;  // in the place of the first four narrow numbers
  uint16_t narrow[kLanes - 4];

  SPLATMILL_INLINE NarrowRecord& operator=(const Record& r) {
    // In the order of a Record, with ux and uy in the places of cut and slope_x.
    const Float all = load(reinterpret_cast<const float*>(&r));
    Float ordered;
#if defined(__AVX512F__)
    const __m512i from = _mm512_setr_epi32(0, 1, 2, 3, kRecordVy, kRecordLevel, kRecordRed, kRecordGreen, kRecordBlue, kRecordDepth,
                                           kRecordUx, kRecordUy, kRecordSlopeY, kRecordExtentX, kRecordExtentY, kRecordOpacity);
    ordered = {{reinterpret_cast<NativeFloat>(_mm512_permutexvar_ps(from, reinterpret_cast<__m512>(all.part[0])))}};
#elif defined(__AVX2__)
    ordered = {{all.part[0], _mm256_blend_ps(all.part[1], all.part[0], 0x0C)}};
#else
    alignas(64) float floats[kLanes];
    store(floats, all);
    floats[kRecordCut] = r.ux, floats[kRecordSlopeX] = r.uy;
    ordered = load(floats);
#endif
    Noise none(0, 0);
    Format::store(reinterpret_cast<char*>(this), ordered, none);
    x = r.x, y = r.y;
    return *this;
  }
};
template <class Format>
SPLATMILL_INLINE Record widened(const NarrowRecord<Format>& r) {
  alignas(64) float wide[kLanes];
  store(wide, Format::load(reinterpret_cast<const char*>(&r)));
  Record out;
  out.x = r.x, out.y = r.y;
  out.vy = wide[kRecordVy], out.level = wide[kRecordLevel];
  for (int c = 0; c < 3; ++c) out.color[c] = wide[kRecordRed + c];
  out.depth = wide[kRecordDepth];
  out.ux = wide[kRecordCut], out.uy = wide[kRecordSlopeX];
  out.cut = out.level - kLog2AlphaMin;
  out.slope_x = -out.uy / out.ux, out.slope_y = wide[kRecordSlopeY];
  out.extent_x = wide[kRecordExtentX], out.extent_y = wide[kRecordExtentY];
  out.opacity = wide[kRecordOpacity];
  return out;
}
SPLATMILL_INLINE const Record& widened(const Record& r) { return r; }

using Harmonics = SPLATMILL_HARMONICS;
using FirstMoment = SPLATMILL_FIRST_MOMENT;
using SecondMoment = SPLATMILL_SECOND_MOMENT;
#ifdef SPLATMILL_RECORD
using StoredRecord = NarrowRecord<SPLATMILL_RECORD>;
#else
using StoredRecord = Record;
#endif

}  // namespace splatmill
