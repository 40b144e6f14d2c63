// Errors of the functions of math.hpp and simd.hpp, float by float, against float64: what `splatmill bench functions` counts.
//
// The kernels' own headers, with the kernels' own flags (worker/CMakeLists.txt), one library per instruction set.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "simd/math.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

// What is kept of many inputs. _studies/functions/library.py declares the same fields.
struct Errors {
  int64_t count, rounded;  // inputs; results that are the exact value's nearest float
  double ulp, relative, absolute;              // largest errors
  double ulp_squares, relative_sum;            // sums over the inputs; the second with signs
  uint32_t at_ulp, at_relative, at_absolute;   // bits of the inputs of the largest errors
};

double power_of_two(int exponent) {
  const uint64_t bits = static_cast<uint64_t>(exponent + 1023) << 52;
  double x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}

// 1 over the distance of neighbouring normal floats at y.
double per_ulp(double y) {
  uint64_t bits;
  std::memcpy(&bits, &y, sizeof bits);
  const int exponent = static_cast<int>(bits >> 52 & 0x7FF) - 1023;
  return power_of_two(23 - (exponent > -126 ? exponent : -126));
}

void enlarge(double& largest, uint32_t& at, double error, uint32_t bits) {
  if (error <= largest) return;
  largest = error >= 0 ? error : std::numeric_limits<double>::infinity();  // NaN must not hide
  at = bits;
}

void compare(Errors& e, uint32_t bits, float got, double exact) {
  const double error = static_cast<double>(got) - exact, size = std::fabs(error);
  const double relative = size == 0 ? 0 : error / std::fabs(exact), ulp = size * per_ulp(exact);
  ++e.count;
  e.rounded += got == static_cast<float>(exact);
  enlarge(e.ulp, e.at_ulp, ulp, bits);
  enlarge(e.relative, e.at_relative, std::fabs(relative), bits);
  enlarge(e.absolute, e.at_absolute, size, bits);
  e.ulp_squares += ulp * ulp;
  e.relative_sum += relative;
}

template <Float function(Float), double exact(double)>
void sweep(uint32_t first, int64_t count, uint32_t stride, Errors& e) {
  const FlushDenormals flush;  // the state that every kernel runs in
  alignas(64) uint32_t bits[kLanes];
  alignas(64) float x[kLanes], y[kLanes];
  for (int64_t k = 0; k < count; k += kLanes) {
    const int lanes = count - k < kLanes ? static_cast<int>(count - k) : kLanes;
    for (int i = 0; i < kLanes; ++i) bits[i] = first + static_cast<uint32_t>(k + (i < lanes ? i : 0)) * stride;
    std::memcpy(x, bits, sizeof x);
    store(y, function(load(x)));
    for (int i = 0; i < lanes; ++i) compare(e, bits[i], y[i], exact(static_cast<double>(x[i])));
  }
}

// Of the floats 4^k x with x in [1, 4) and first <= k <= last, how many do not give exactly 2^(k power) function(x).
template <Float function(Float)>
int64_t unlike(int first, int last, int power) {
  const FlushDenormals flush;
  constexpr int32_t kOne = 127 << 23, kFour = 129 << 23, kDouble = 1 << 23;
  alignas(64) int32_t places[kLanes];
  alignas(64) float x[kLanes];
  int64_t found = 0;
  for (int32_t one = kOne; one < kFour; one += kLanes) {
    for (int i = 0; i < kLanes; ++i) places[i] = one + i;
    std::memcpy(x, places, sizeof x);
    const Int input = as_int(load(x)), result = as_int(function(load(x)));
    for (int k = first; k <= last; ++k) {
      const Int got = as_int(function(as_float(input + 2 * k * kDouble)));
      found += kLanes - __builtin_popcount(bits(got == result + splat(k * power * kDouble)));
    }
  }
  return found;
}

double exact_exp(double x) { return std::exp(x); }
double exact_log2(double x) { return std::log2(x); }
double exact_exp2(double x) { return std::exp2(x); }
double exact_reciprocal(double x) { return 1.0 / x; }
double exact_reciprocal_sqrt(double x) { return 1.0 / std::sqrt(x); }
double exact_sqrt(double x) { return std::sqrt(x); }

struct Function {
  const char* name;
  void (*sweep)(uint32_t first, int64_t count, uint32_t stride, Errors& e);
  double (*exact)(double);
  int64_t (*unlike)(int first, int last, int power);
};

const Function kFunctions[] = {
    {"exp", sweep<exp, exact_exp>, exact_exp, unlike<exp>},
    {"log2", sweep<log2, exact_log2>, exact_log2, unlike<log2>},
    {"exp2_of_alpha", sweep<exp2_of_alpha, exact_exp2>, exact_exp2, unlike<exp2_of_alpha>},
    {"reciprocal", sweep<reciprocal, exact_reciprocal>, exact_reciprocal, unlike<reciprocal>},
    {"reciprocal_sqrt", sweep<reciprocal_sqrt, exact_reciprocal_sqrt>, exact_reciprocal_sqrt, unlike<reciprocal_sqrt>},
    {"sqrt", sweep<sqrt, exact_sqrt>, exact_sqrt, unlike<sqrt>},
};

const Function* find(const char* name) {
  for (const Function& f : kFunctions)
    if (std::strcmp(f.name, name) == 0) return &f;
  return nullptr;
}

}  // namespace
}  // namespace splatmill

extern "C" {

// Adds the errors at the floats with bits first, first + stride, ... to `e`. False where there is no such function.
__attribute__((visibility("default"))) bool add_errors(const char* name, uint32_t first, int64_t count, uint32_t stride,
                                                        splatmill::Errors* e) {
  const splatmill::Function* f = splatmill::find(name);
  if (f) f->sweep(first, count, stride, *e);
  return f != nullptr;
}

// How many of the floats of other octaves differ from those of [1, 4) by more than a power of two; -1 for no such function.
__attribute__((visibility("default"))) int64_t unlike_octaves(const char* name, int first, int last, int power) {
  const splatmill::Function* f = splatmill::find(name);
  return f ? f->unlike(first, last, power) : -1;
}

// The float64 value that the function is compared with; NaN where there is no such function.
__attribute__((visibility("default"))) double exact(const char* name, double x) {
  const splatmill::Function* f = splatmill::find(name);
  return f ? f->exact(x) : std::numeric_limits<double>::quiet_NaN();
}

}  // extern "C"
