"""The endpoints of meshes: made in the background, and kept with their model."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.backplane.storage import layout
from splatmill.schema import Mesh, MeshFormat, MeshList, MeshRequest
from splatmill_server.access.caller import Who
from splatmill_server.requests.ownership import ModelId
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.responses.files import file_response
from splatmill_server.routes.openapi import JSON_BODY, OF_MODEL, answer, binary, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/models", tags=["models"])

MeshId = Annotated[str, Path(description="Id of the mesh.")]

_MEDIA = {MeshFormat.glb: "model/gltf-binary", MeshFormat.ply: "application/octet-stream"}


@router.post(
    "/{model_id}/meshes",
    status_code=202,
    responses=answer(200, "The mesh of this request, which is there already", model=Mesh)
    | problems(
        *OF_MODEL,
        "file_not_found",
        "too_many_meshes",
        *JSON_BODY,
        "invalid_request",
        "quota_exceeded",
        "storage_full",
        "renderer_unavailable",
    ),
    dependencies=[JSON_ONLY],
)
async def create_mesh(
    service: Shared,
    who: Who,
    response: Response,
    model_id: ModelId,
    body: Annotated[MeshRequest | None, Body(examples=[{"faces": 100_000}])] = None,
) -> Mesh:
    """Make a mesh of the model in the background, and keep it with the model: triangles with a colour at each vertex.

    `Location` answers what is being done. The same request returns the same mesh, and begins one that has failed again.
    """
    made = await service.meshes.create(model_id, body or MeshRequest(), who)
    response.headers["Location"] = made.links["self"]
    if made.state.final:
        response.status_code = 200
    return made


@router.get("/{model_id}/meshes", responses=problems(*OF_MODEL))
def list_meshes(service: Shared, model_id: ModelId) -> MeshList:
    """List the meshes of a model, newest first."""
    return MeshList(meshes=service.meshes.list(model_id))


@router.get("/{model_id}/meshes/{mesh_id}", responses=problems(*OF_MODEL, "mesh_not_found"))
def get_mesh(service: Shared, model_id: ModelId, mesh_id: MeshId) -> Mesh:
    """Get a mesh: its state, what is being done, and its triangles, its size or the problem at its end."""
    return service.meshes.get(model_id, mesh_id)


@router.delete(
    "/{model_id}/meshes/{mesh_id}", status_code=204, responses=problems(*OF_MODEL, "mesh_not_found")
)
async def delete_mesh(service: Shared, model_id: ModelId, mesh_id: MeshId) -> None:
    """Delete a mesh; one that is not whole is cancelled."""
    await service.meshes.delete(model_id, mesh_id)


@router.head("/{model_id}/meshes/{mesh_id}/file", include_in_schema=False)
@router.get(
    "/{model_id}/meshes/{mesh_id}/file",
    response_class=Response,
    responses=binary("The mesh", "model/gltf-binary")
    | answer(206, "The requested range of the mesh")
    | answer(304, "The mesh is unchanged")
    | problems(*OF_MODEL, "mesh_not_found", "mesh_not_ready", "file_not_found", "range_not_satisfiable"),
)
async def get_mesh_file(service: Shared, model_id: ModelId, mesh_id: MeshId, request: Request) -> Response:
    """Download a mesh, in the format of its request."""
    mesh = await run_in_threadpool(service.meshes.get_whole, model_id, mesh_id)
    path = layout.mesh_file(model_id, mesh_id)
    return await file_response(request, service.storage, path, _MEDIA[mesh.request.format])
