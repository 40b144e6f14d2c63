// Adam over all parameter groups of a scene in one parallel pass, dense or for the visible rows alone.
#include "adam.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "bindings.hpp"
#include "threads.hpp"

namespace splatmill {
namespace {

struct Group {
  float *p, *m, *v;
  const float* g;
  int64_t width;  // values per row
  float rate;
};

// Updates one run of values; returns how many gradient values were refused.
int64_t update_run(const Group& group, int64_t begin, int64_t end, float rate, const AdamStep& scale) {
  int64_t refused = 0;
  for (int64_t i = begin; i < end; i += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(end - i, kLanes));
    Float p = load_first(group.p + i, count), m = load_first(group.m + i, count), v = load_first(group.v + i, count);
    const Mask good = adam_update(p, m, v, load_first(group.g + i, count), splat(rate), scale);
    refused += kLanes - __builtin_popcount(bits(good));
    store_first(group.p + i, p, count);
    store_first(group.m + i, m, count);
    store_first(group.v + i, v, count);
  }
  return refused;
}

// Missed steps whose drift is computed: as in reference/adam.py.
constexpr int64_t kMemory = 256;

// sum over s = last + j, last < s <= step, of beta1^j / (1 - beta1^s) * sqrt((1 - beta2^s) / beta2^j)
double drift(int64_t last, int64_t step, double beta2) {
  double total = 0, decay = 1;
  for (int64_t j = 1; j <= std::min(step - last, kMemory); ++j) {
    const double s = static_cast<double>(last + j);
    decay *= kBeta1 / std::sqrt(beta2);
    total += decay / (1 - std::pow(kBeta1, s)) * std::sqrt(1 - std::pow(beta2, s));
  }
  return total;
}

// Moves a run as dense Adam with zero gradients would have done since it was last current.
void catch_up_run(const Group& group, int64_t begin, int64_t end, double travel, double decay1, double decay2) {
  for (int64_t i = begin; i < end; ++i) {
    const float m = group.m[i], v = group.v[i];
    if (v > 0) group.p[i] -= static_cast<float>(group.rate * travel) * (m / std::sqrt(v));
    group.m[i] = static_cast<float>(m * decay1);
    group.v[i] = static_cast<float>(v * decay2);
  }
}

}  // namespace

// Returns how many gradient values were refused. With `visible`, other rows stay, and `last_step` is the step each row is at.
int64_t adam(const std::vector<Group>& groups, int64_t rows, int64_t step, const bool* visible, int32_t* last_step,
             double beta2, int threads) {
  const AdamStep scale(step, beta2);
  int64_t refused = 0;
#pragma omp parallel num_threads(threads) reduction(+ : refused)
  {
    FlushDenormals flush;
    const int64_t t = omp_get_thread_num(), all = omp_get_num_threads();
    if (!visible) {
      for (const Group& group : groups) {
        // Threads divide the values at whole vectors, so that every value is computed by the same arithmetic on any number.
        const int64_t vectors = (rows * group.width + kLanes - 1) / kLanes, size = rows * group.width;
        refused += update_run(group, std::min(size, vectors * t / all * kLanes),
                              std::min(size, vectors * (t + 1) / all * kLanes), group.rate * scale.size, scale);
      }
    } else {
      int64_t missed_before = 0;  // the three factors are kept: neighbours have mostly missed the same steps
      double travel = 0, decay1 = 1, decay2 = 1;
      for (int64_t row = rows * t / all; row < rows * (t + 1) / all; ++row) {
        if (!visible[row]) continue;
        const int64_t missed = std::max<int64_t>(step - 1 - last_step[row], 0);
        if (missed != missed_before) {
          travel = drift(step - 1 - missed, step - 1, beta2);
          decay1 = std::pow(kBeta1, static_cast<double>(missed));
          decay2 = std::pow(beta2, static_cast<double>(missed));
          missed_before = missed;
        }
        for (const Group& group : groups) {
          const int64_t begin = row * group.width, end = begin + group.width;
          if (missed > 0) catch_up_run(group, begin, end, travel, decay1, decay2);
          refused += update_run(group, begin, end, group.rate * scale.size, scale);
        }
        last_step[row] = static_cast<int32_t>(step);
      }
    }
  }
  return refused;
}

void bind_adam(nb::module_& m) {
  using Values = Tensor<float, nb::ndim<2>>;
  using Gradients = Tensor<const float, nb::ndim<2>>;
  m.def(
      "adam",
      [](const std::vector<Values>& params, const std::vector<Gradients>& grads, const std::vector<Values>& exp_avg,
         const std::vector<Values>& exp_avg_sq, const std::vector<double>& rates, int64_t step,
         std::optional<Tensor<const bool, nb::ndim<1>>> visible, std::optional<Tensor<int32_t, nb::ndim<1>>> last_step,
         double beta2, int threads) {
        std::vector<Group> groups;
        for (std::size_t i = 0; i < params.size(); ++i)
          groups.push_back({params[i].data(), exp_avg[i].data(), exp_avg_sq[i].data(), grads[i].data(),
                            static_cast<int64_t>(params[i].shape(1)), static_cast<float>(rates[i])});
        const int64_t rows = params.empty() ? 0 : static_cast<int64_t>(params[0].shape(0));
        nb::gil_scoped_release release;
        return adam(groups, rows, step, visible ? visible->data() : nullptr, last_step ? last_step->data() : nullptr, beta2,
                    threads > 0 ? threads : default_threads());
      },
      nb::arg("params").noconvert(), nb::arg("grads").noconvert(), nb::arg("exp_avg").noconvert(),
      nb::arg("exp_avg_sq").noconvert(), nb::arg("rates"), nb::arg("step"), nb::arg("visible").noconvert().none(),
      nb::arg("last_step").noconvert().none(), nb::arg("beta2"), nb::arg("threads") = 0,
      "One Adam step in place over groups [rows, width]; returns how many gradient values were refused as not finite.");
}

}  // namespace splatmill
