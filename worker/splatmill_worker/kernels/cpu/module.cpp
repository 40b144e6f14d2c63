// The extension module: one line per op. Built once per instruction set under the name SPLATMILL_MODULE.
#include "bindings.hpp"
#include "threads.hpp"

namespace splatmill {

// Which builds this processor can run, best first. Asked of the baseline module, which runs anywhere.
std::vector<std::string> supported() {
  std::vector<std::string> names;
#if defined(SPLATMILL_X86)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                    __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
    names.push_back("avx512");
  if (avx2) names.push_back("avx2");
#endif
  names.push_back("baseline");
  return names;
}

}  // namespace splatmill

NB_MODULE(SPLATMILL_MODULE, m) {
  using namespace splatmill;
  m.def("supported", &supported, "Instruction sets this processor can run, best first.");
  m.def("default_threads", &default_threads, "Threads an op uses when not told: the affinity mask and OMP_NUM_THREADS.");
}
