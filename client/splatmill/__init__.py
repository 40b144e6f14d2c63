"""Splatmill: photos in, Gaussian splats out. The SDK, the wire schema and the command line.

Start with `from splatmill import Client`. Names are imported when they are first used, so that `import splatmill`
stays fast; the server and the worker import it too, for the schema.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:  # `as` exports a name to type checkers
    from splatmill.errors import JobCancelled as JobCancelled
    from splatmill.errors import JobFailed as JobFailed
    from splatmill.errors import SplatmillError as SplatmillError
    from splatmill.errors import WaitTimeout as WaitTimeout
    from splatmill.schema import CameraSpec as CameraSpec
    from splatmill.schema import OrbitRequest as OrbitRequest
    from splatmill.schema import RenderRequest as RenderRequest
    from splatmill.schema import TrainOptions as TrainOptions
    from splatmill.sdk.aio import AsyncClient as AsyncClient
    from splatmill.sdk.client import Client as Client
    from splatmill.sdk.client import JobHandle as JobHandle
    from splatmill.sdk.client import ModelHandle as ModelHandle
    from splatmill.sdk.job import AsyncJobHandle as AsyncJobHandle
    from splatmill.sdk.model import AsyncModelHandle as AsyncModelHandle
    from splatmill.sdk.webhook_signature import InvalidWebhook as InvalidWebhook
    from splatmill.sdk.webhook_signature import verify_webhook as verify_webhook

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

if not TYPE_CHECKING:
    __all__ = [*_MODULES, "__version__"]


def __getattr__(name: str) -> Any:
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'splatmill' has no attribute {name!r}")
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    return [*_MODULES, "__version__"]
