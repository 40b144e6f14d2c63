"""The ops on tensors, each in up to three backends under one stem: plain torch as the definition, C++ and Triton."""
