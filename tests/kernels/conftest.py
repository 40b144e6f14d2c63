"""Without a GPU, Triton's kernels run in its interpreter, which has to be asked for before Triton is first imported."""

from tests.support.kernels.interpreter import ask_for_it

ask_for_it()
