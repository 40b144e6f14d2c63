"""Splatmill: photos in, Gaussian splats out. The SDK, the wire schema and the command line.

Start with `from splatmill import Client`. Names are imported when they are first used, so that `import splatmill`
stays fast; the server and the worker import it too, for the schema.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from splatmill.errors import JobCancelled, JobFailed, SplatmillError, WaitTimeout
    from splatmill.schema import CameraSpec, OrbitRequest, RenderRequest, TrainOptions
    from splatmill.sdk.aio import AsyncClient
    from splatmill.sdk.client import Client, JobHandle, ModelHandle
    from splatmill.sdk.job import AsyncJobHandle
    from splatmill.sdk.model import AsyncModelHandle
    from splatmill.sdk.webhook_signature import InvalidWebhook, verify_webhook

_MODULES = {
    "AsyncClient": "splatmill.sdk.aio",
    "AsyncJobHandle": "splatmill.sdk.job",
    "AsyncModelHandle": "splatmill.sdk.model",
    "CameraSpec": "splatmill.schema",
    "Client": "splatmill.sdk.client",
    "JobCancelled": "splatmill.errors",
    "JobFailed": "splatmill.errors",
    "JobHandle": "splatmill.sdk.client",
    "ModelHandle": "splatmill.sdk.client",
    "OrbitRequest": "splatmill.schema",
    "RenderRequest": "splatmill.schema",
    "SplatmillError": "splatmill.errors",
    "TrainOptions": "splatmill.schema",
    "InvalidWebhook": "splatmill.sdk.webhook_signature",
    "verify_webhook": "splatmill.sdk.webhook_signature",
    "WaitTimeout": "splatmill.errors",
}

__all__ = [
    "AsyncClient",
    "AsyncJobHandle",
    "AsyncModelHandle",
    "CameraSpec",
    "Client",
    "InvalidWebhook",
    "JobCancelled",
    "JobFailed",
    "JobHandle",
    "ModelHandle",
    "OrbitRequest",
    "RenderRequest",
    "SplatmillError",
    "TrainOptions",
    "WaitTimeout",
    "__version__",
    "verify_webhook",
]


def __getattr__(name: str) -> Any:
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'splatmill' has no attribute {name!r}")
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    return __all__
