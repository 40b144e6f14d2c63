"""The Triton backend: the same ops under the same stems as `reference` and `cpu`.

Importing this package imports no Triton, touches no GPU and compiles nothing; the modules with kernels are
imported by the dispatch in `ops` when a tensor on a GPU arrives. Kernels compile on first use and stay in
Triton's cache on disk, as do the settings measured by its autotuner. With TRITON_INTERPRET=1 the very same
kernels run on CPU tensors, for proof and not for use.
"""
