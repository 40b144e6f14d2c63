"""The parts of `bench soak`: the service under test, its clients, the faults, and what must hold at the end."""
