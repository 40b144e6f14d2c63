// The extension module: one line per op. Built once per instruction set under the name SPLATMILL_MODULE.
#include "bindings/arguments.hpp"
#include "layout/frame.hpp"
#include "simd/threads.hpp"
#include "tiles/touches.hpp"

namespace splatmill {

void bind_bin(nb::module_& m);
void bind_clusters(nb::module_& m);
void bind_composite(nb::module_& m);
void bind_correlate(nb::module_& m);
void bind_knn(nb::module_& m);
void bind_loss(nb::module_& m);
void bind_median_depth(nb::module_& m);
void bind_pack(nb::module_& m);
void bind_project(nb::module_& m);
void bind_step(nb::module_& m);

// The builds that this processor can run, best first. isa.py asks the baseline module, which runs anywhere.
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
  nb::set_leak_warnings(false);  // tensors that live until exit keep frames alive, which is no leak
  nb::register_exception_translator([](const std::exception_ptr& thrown, void*) {
    try {
      std::rethrow_exception(thrown);
    } catch (const TooManyPairs& error) {
      PyErr_SetString(nb::module_::import_("splatmill_worker.kernels.records").attr("TooManyPairs").ptr(), error.what());
    }
  });
  m.def("supported", &supported, "The builds that this processor can run, best first.");
  m.def("default_threads", &default_threads,
        "The number of threads that an op uses by default: that of OMP_NUM_THREADS, at most that of the affinity mask.");
  nb::class_<Camera>(m, "Camera", "A pinhole camera: viewmat [4,4] and K [3,3] float32, image size in pixels.")
      .def(
          "__init__",
          [](Camera* self, Matrix4 viewmat, Tensor<float, nb::shape<3, 3>> K, int width, int height, float near,
             bool antialias) { new (self) Camera(make_camera(viewmat.data(), K.data(), width, height, near, antialias)); },
          "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a, "height"_a, "near"_a, "antialias"_a);
  nb::class_<Frame>(m, "Frame", "The intermediate results of one view, in buffers that grow as needed and are reused.")
      .def(nb::init<>())
      .def_prop_ro(
          "seconds",
          [](const Frame& f) {
            return std::make_tuple(f.seconds.project, f.seconds.bin, f.seconds.forward, f.seconds.backward, f.seconds.update);
          },
          "Wall seconds of the last project, bin, composite forward, composite backward and update.")
      .def_prop_ro(
          "slots", [](const Frame& f) { return f.touches.capacity(); },
          "(tile, Gaussian) pairs that there is room for, at 12 bytes each, and at 64 more once gradients were taken.");
  bind_bin(m);
  bind_clusters(m);
  bind_composite(m);
  bind_correlate(m);
  bind_knn(m);
  bind_loss(m);
  bind_median_depth(m);
  bind_pack(m);
  bind_project(m);
  bind_step(m);
}
