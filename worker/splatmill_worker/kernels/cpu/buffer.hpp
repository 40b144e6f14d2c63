// Aligned memory that grows and is kept from step to step.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <new>

namespace splatmill {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // Room for `count` elements; what was there is lost when it has to grow. Grows by half, so that a slowly growing scene does
  // not allocate at every step. Throws std::bad_alloc.
  T* reserve(int64_t count) {
    if (count > capacity_) {
      const int64_t wanted = count > capacity_ + capacity_ / 2 ? count : capacity_ + capacity_ / 2;
      std::free(data_);
      data_ = nullptr;
      capacity_ = 0;
      const size_t bytes = (static_cast<size_t>(wanted) * sizeof(T) + 63) / 64 * 64;
      data_ = static_cast<T*>(std::aligned_alloc(64, bytes));
      if (!data_) throw std::bad_alloc();
      capacity_ = wanted;
    }
    return data_;
  }
  T* get() const { return data_; }
  T& operator[](int64_t i) const { return data_[i]; }
  int64_t capacity() const { return capacity_; }

 private:
  T* data_ = nullptr;
  int64_t capacity_ = 0;
};

}  // namespace splatmill
