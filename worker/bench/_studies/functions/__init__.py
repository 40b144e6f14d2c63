"""Parts of `bench functions`: functions and their arguments, the library that counts errors, what follows."""
