"""The addresses of what belongs to a job."""

from splatmill.schema import Job
from splatmill_server.base.root_path import address


def with_links(job: Job) -> Job:
    """Return the job with the addresses of what belongs to it."""
    base = address(f"/v1/jobs/{job.id}")
    links = {"self": base, "events": f"{base}/events", "logs": f"{base}/logs", "preview": f"{base}/preview"}
    links |= {"cameras": f"{base}/cameras", "capture": address(f"/v1/captures/{job.capture}")}
    if job.state.final:
        links["restart"] = f"{base}/restart"
    else:
        links |= {"cancel": f"{base}/cancel", "watch": f"{base}/watch", "snapshot": f"{base}/snapshot"}
    if job.model is not None:
        links |= {"report": f"{base}/report", "model": address(f"/v1/models/{job.model}")}
    return job.model_copy(update={"links": links})
