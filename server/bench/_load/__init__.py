"""The parts of `bench load`: the clients, which are locust's."""
