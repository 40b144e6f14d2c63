"""Parts of `bench gpu`. Those up to `tiles` need torch, Triton and the kernels alone."""
