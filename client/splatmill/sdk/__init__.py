"""The SDK: clients, and the jobs, models and other records that they return."""
