"""Parts of `bench capacity`: counting operations, and records of as many captures, jobs and models as are asked for."""
