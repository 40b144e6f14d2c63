// Types of the arguments that Python passes: scenes in blocks, rows of tensors, matrices and images.
#pragma once

#include "bindings/bindings.hpp"
#include "layout/camera.hpp"
#include "layout/layout.hpp"

namespace splatmill {

using namespace nb::literals;

using Blocks = Tensor<float, nb::shape<-1, kRows, kLanes>>;  // parameters, moments or gradients
using Row = Tensor<float, nb::shape<-1>>;
template <int N>
using Rows = Tensor<float, nb::shape<-1, N>>;
using Matrix4 = Tensor<float, nb::shape<4, 4>>;
using WaveRows = Tensor<int32_t, nb::ndim<1>>;  // the wave of each Gaussian, below 0 for none
using Image = Tensor<float, nb::ndim<3>>;  // [3 or 5, rows, stride], both padded to whole tiles

inline Planes planes_of(const Image& image, const Camera& cam) {
  const auto stride = static_cast<int64_t>(image.shape(2));
  return {image.data(), cam.width, cam.height, stride, stride * static_cast<int64_t>(image.shape(1))};
}

}  // namespace splatmill
