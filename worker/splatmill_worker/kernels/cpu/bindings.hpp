// What every op's file shares with Python: tensor arguments that are views (never copies), and errors that name the argument.
//
// An op's file `foo.cpp` ends with `void bind_foo(nb::module_& m)`; module.cpp calls it. Outputs are allocated in torch by the
// caller and passed in, so that nothing here needs to link torch.
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
