"""The job queue, built on RQ: its entries, the lines in which they wait, and the leases of those that run.

RQ starts attempts, keeps their records, counts their retries and stops them on request. Lines and leases are our own:
by its public interface alone RQ does not serve an owner who comes later, loses an entry whose worker dies as it takes
it from one of several queues, takes over a minute to notice a lost machine, and runs work twice where a machine slept
or its clock is wrong (measured by `splatmill bench rq_alone`).
"""
