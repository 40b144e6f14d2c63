"""What the tests of the kernels share: scenes, tolerances, and a process that trains with others."""
