// What the files of the ops need to be called from Python. Tensors arrive as views, never as copies.
//
// The file `foo.cpp` of an op ends with `void bind_foo(nb::module_& m)`, which module.cpp calls. The caller allocates outputs in
// torch and passes them, so that nothing here links torch.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

namespace splatmill {

namespace nb = nanobind;

// C-contiguous CPU tensors. nanobind refuses another dtype, device, rank or stride (`noconvert` keeps it from copying).
template <class T, class Shape>
using Tensor = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;

}  // namespace splatmill
