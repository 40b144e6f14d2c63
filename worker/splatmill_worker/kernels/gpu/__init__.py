"""The Triton backend: the same ops under the same stems as in `reference` and `cpu`.

Importing this package imports no Triton, touches no GPU and compiles nothing; `ops` imports the modules with kernels
when the backend is used. Kernels compile on first use and stay in Triton's cache on disk, and so do the settings that
its autotuner measured. With TRITON_INTERPRET=1 the same kernels run on CPU tensors: slowly, to test them.
"""
