// Aligned memory that grows, and is kept from step to step.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace splatmill {

inline constexpr size_t kHugePage = size_t{2} << 20;  // bytes

// Advises the system to back the whole huge pages within [p, p + bytes) by such: with small pages, random access misses the TLB
// at every other access. Nothing depends on it.
inline void advise_huge_pages(void* p, size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  const auto begin = (reinterpret_cast<uintptr_t>(p) + kHugePage - 1) / kHugePage * kHugePage;
  const auto end = (reinterpret_cast<uintptr_t>(p) + bytes) / kHugePage * kHugePage;
  if (begin < end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#else
  (void)p, (void)bytes;
#endif
}

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // Makes room for `count` elements; the old ones are lost when it grows. Grows by half at least, so that a slowly growing scene
  // does not allocate at every step. Throws std::bad_alloc.
  T* reserve(int64_t count) {
    if (count > capacity_) {
      const int64_t wanted = count > capacity_ + capacity_ / 2 ? count : capacity_ + capacity_ / 2;
      std::free(data_);
      data_ = nullptr;
      capacity_ = 0;
      const size_t exact = static_cast<size_t>(wanted) * sizeof(T), alignment = exact < 2 * kHugePage ? 64 : kHugePage;
      const size_t bytes = (exact + alignment - 1) / alignment * alignment;
      data_ = static_cast<T*>(std::aligned_alloc(alignment, bytes));
      if (!data_) throw std::bad_alloc();
      advise_huge_pages(data_, bytes);
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
