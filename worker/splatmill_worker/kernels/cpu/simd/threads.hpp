// The number of threads, and the floating-point state that they run in.
#pragma once

#include <omp.h>
#if defined(__linux__)
#include <sched.h>
#endif

#include <algorithm>
#include <cstdint>

#include "simd/simd.hpp"

namespace splatmill {

// The number that OpenMP uses (OMP_NUM_THREADS), at most the number of processors that this process may run on now.
inline int default_threads() {
  int n = omp_get_max_threads();
#if defined(__linux__)
  cpu_set_t allowed;
  if (sched_getaffinity(0, sizeof allowed, &allowed) == 0) n = std::min(n, CPU_COUNT(&allowed));
#endif
  return std::max(n, 1);
}

// Flushes denormals to zero on this thread while it lives, and restores the state at its end. Every parallel region begins with
// one: a denormal operand costs over a hundred cycles, and none matters to an image.
class FlushDenormals {
 public:
#if defined(SPLATMILL_X86)
  FlushDenormals() : saved_(_mm_getcsr()) { _mm_setcsr(saved_ | 0x8040u); }
  ~FlushDenormals() { _mm_setcsr(saved_); }

 private:
  unsigned saved_;
#elif defined(__aarch64__)
  FlushDenormals() {
    asm volatile("mrs %0, fpcr" : "=r"(saved_));
    asm volatile("msr fpcr, %0" ::"r"(saved_ | (uint64_t{1} << 24)));
  }
  ~FlushDenormals() { asm volatile("msr fpcr, %0" ::"r"(saved_)); }

 private:
  uint64_t saved_;
#else
  FlushDenormals() = default;
#endif
  FlushDenormals(const FlushDenormals&) = delete;
  FlushDenormals& operator=(const FlushDenormals&) = delete;
};

}  // namespace splatmill
