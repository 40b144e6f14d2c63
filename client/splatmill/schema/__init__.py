"""The wire schema: every request, response, event, option and problem of the service.

All of it is imported when the first name of this package is used. `port`, `quantities` and the modules of `files`
but `names` load no message: with them alone, `splatmill up` and the processes that decode photos start sooner.
"""

from importlib import import_module
from pkgutil import walk_packages
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # `as` exports a name to type checkers
    from splatmill.schema.base import (  # noqa: I001  # ruff would give each name an import of its own
        ByteSize as ByteSize,
        Duration as Duration,
        Measured as Measured,
        Request as Request,
        Response as Response,
        Time as Time,
    )
    from splatmill.schema.cameras import (
        DEPTH_SCALE_HEADER as DEPTH_SCALE_HEADER,
        MAX_RENDER_PIXELS as MAX_RENDER_PIXELS,
        MAX_RENDER_SIDE as MAX_RENDER_SIDE,
        RIGID_TOLERANCE as RIGID_TOLERANCE,
        CameraSpec as CameraSpec,
        Color as Color,
        Convention as Convention,
        Format as Format,
        Matrix as Matrix,
        MatrixRow as MatrixRow,
        Output as Output,
        RenderRequest as RenderRequest,
        Side as Side,
    )
    from splatmill.schema.files.formats import (
        DOWNLOADS as DOWNLOADS,
        MODEL_FORMATS as MODEL_FORMATS,
        ModelFormat as ModelFormat,
    )
    from splatmill.schema.files.masks import (
        MASK_BEGINNINGS as MASK_BEGINNINGS,
        MASK_ENDINGS as MASK_ENDINGS,
        MASK_FOLDERS as MASK_FOLDERS,
    )
    from splatmill.schema.files.names import (
        MAX_NAME_BYTES as MAX_NAME_BYTES,
        MAX_PART_BYTES as MAX_PART_BYTES,
        MAX_PARTS as MAX_PARTS,
        FileName as FileName,
        UnsafeName as UnsafeName,
        safe_name as safe_name,
        storable_name as storable_name,
    )
    from splatmill.schema.files.outputs import OUTPUT_MARKS as OUTPUT_MARKS, OUTPUT_MEDIA as OUTPUT_MEDIA
    from splatmill.schema.files.photos import (
        ARCHIVE_SUFFIXES as ARCHIVE_SUFFIXES,
        EXAMPLE_FILE as EXAMPLE_FILE,
        MASK_SUFFIXES as MASK_SUFFIXES,
        MAX_PHOTO_PIXELS as MAX_PHOTO_PIXELS,
        MIN_PHOTO_SIDE as MIN_PHOTO_SIDE,
        MIN_PHOTOS as MIN_PHOTOS,
        PHOTO_SUFFIXES as PHOTO_SUFFIXES,
        UNREAD_KINDS as UNREAD_KINDS,
        VIDEO_SUFFIXES as VIDEO_SUFFIXES,
    )
    from splatmill.schema.fit_image import FitImageOptions as FitImageOptions
    from splatmill.schema.frames import (
        GeographicOrigin as GeographicOrigin,
        KnownDistance as KnownDistance,
        ModelFrame as ModelFrame,
        known_distance as known_distance,
    )
    from splatmill.schema.options import (
        PHOTOS_PER_VALIDATION as PHOTOS_PER_VALIDATION,
        PRESET_GAIN as PRESET_GAIN,
        PRESET_LONGEST as PRESET_LONGEST,
        PRESET_STEPS as PRESET_STEPS,
        PRESET_VISITS as PRESET_VISITS,
        Backend as Backend,
        Background as Background,
        Effort as Effort,
        Mapper as Mapper,
        Matcher as Matcher,
        OptionHelp as OptionHelp,
        OptionList as OptionList,
        OptionType as OptionType,
        Preset as Preset,
        ProgressVideo as ProgressVideo,
        Switch as Switch,
        TrainOptions as TrainOptions,
        describe_options as describe_options,
        preset_steps as preset_steps,
    )
    from splatmill.schema.port import DEFAULT_PORT as DEFAULT_PORT
    from splatmill.schema.problems import (
        PROBLEM_MEDIA_TYPE as PROBLEM_MEDIA_TYPE,
        PROBLEMS as PROBLEMS,
        Kind as Kind,
        Problem as Problem,
        code_for_status as code_for_status,
    )
    from splatmill.schema.quantities import (
        format_bytes as format_bytes,
        format_duration as format_duration,
        parse_bytes as parse_bytes,
        parse_duration as parse_duration,
    )
    from splatmill.schema.resources.access import (
        DEFAULT_OWNER as DEFAULT_OWNER,
        CreateKey as CreateKey,
        Key as Key,
        KeyLimits as KeyLimits,
        KeyList as KeyList,
        KeyWithSecret as KeyWithSecret,
        Me as Me,
        NewKeyLimits as NewKeyLimits,
        Owner as Owner,
        RotateKey as RotateKey,
        Scope as Scope,
        Use as Use,
    )
    from splatmill.schema.resources.bin import BinKind as BinKind, BinList as BinList, Binned as Binned
    from splatmill.schema.resources.captures import (
        SHA256_HEADER as SHA256_HEADER,
        Capture as Capture,
        CaptureFile as CaptureFile,
        CapturePage as CapturePage,
        CreateCapture as CreateCapture,
        Role as Role,
        may_be_empty as may_be_empty,
    )
    from splatmill.schema.resources.imports import (
        CreateImport as CreateImport,
        Import as Import,
        ImportList as ImportList,
        ImportState as ImportState,
    )
    from splatmill.schema.resources.info import (
        Accepted as Accepted,
        Health as Health,
        Info as Info,
        Lan as Lan,
        LanAccess as LanAccess,
        Limits as Limits,
        QueueInfo as QueueInfo,
        Ready as Ready,
        Unread as Unread,
        WorkerInfo as WorkerInfo,
    )
    from splatmill.schema.resources.jobs.estimates import (
        Estimate as Estimate,
        EstimateJob as EstimateJob,
        StageEstimate as StageEstimate,
    )
    from splatmill.schema.resources.jobs.events import (
        EVENT as EVENT,
        FINAL_STATES as FINAL_STATES,
        CamerasEvent as CamerasEvent,
        Curve as Curve,
        CurveRow as CurveRow,
        Event as Event,
        EventRecord as EventRecord,
        JobState as JobState,
        LogEvent as LogEvent,
        MetricEvent as MetricEvent,
        PlanEvent as PlanEvent,
        PreviewEvent as PreviewEvent,
        Progress as Progress,
        ProgressEvent as ProgressEvent,
        SnapshotEvent as SnapshotEvent,
        StateEvent as StateEvent,
        UnitEvent as UnitEvent,
    )
    from splatmill.schema.resources.jobs.jobs import (
        IDEMPOTENCY_HEADER as IDEMPOTENCY_HEADER,
        CreateJob as CreateJob,
        Job as Job,
        JobPage as JobPage,
        LogLine as LogLine,
        LogPage as LogPage,
    )
    from splatmill.schema.resources.jobs.labels import ChangeLabels as ChangeLabels, ListOrder as ListOrder
    from splatmill.schema.resources.jobs.live import (
        SNAPSHOT_MEDIA_TYPE as SNAPSHOT_MEDIA_TYPE,
        PlacedCamera as PlacedCamera,
        Placement as Placement,
        UnusedPhoto as UnusedPhoto,
        Watch as Watch,
    )
    from splatmill.schema.resources.models.conversions import (
        CONVERSION_HEADER as CONVERSION_HEADER,
        CONVERSION_VERSION as CONVERSION_VERSION,
        ComparedWith as ComparedWith,
        Conversion as Conversion,
        ConversionRequest as ConversionRequest,
        ModelDownload as ModelDownload,
        ModelDownloads as ModelDownloads,
    )
    from splatmill.schema.resources.models.edits import (
        EDIT_HEADER as EDIT_HEADER,
        Box as Box,
        Edited as Edited,
        EditedView as EditedView,
        EditModel as EditModel,
    )
    from splatmill.schema.resources.models.kept import Kept as Kept, KeptState as KeptState
    from splatmill.schema.resources.models.meshes import (
        Mesh as Mesh,
        MeshFacts as MeshFacts,
        MeshFormat as MeshFormat,
        MeshList as MeshList,
        MeshRequest as MeshRequest,
    )
    from splatmill.schema.resources.models.models import (
        HELD_OUT as HELD_OUT,
        TIME_LAPSE as TIME_LAPSE,
        Model as Model,
        ModelCamera as ModelCamera,
        ModelCameras as ModelCameras,
        ModelFile as ModelFile,
        ModelPage as ModelPage,
        Report as Report,
        StageSeconds as StageSeconds,
    )
    from splatmill.schema.resources.models.orbits import (
        JoinOrbit as JoinOrbit,
        Orbit as Orbit,
        OrbitFrames as OrbitFrames,
        OrbitList as OrbitList,
    )
    from splatmill.schema.resources.models.presentation import (
        MOST_MARKS as MOST_MARKS,
        POSTER as POSTER,
        Annotation as Annotation,
        ChangePresentation as ChangePresentation,
        Measurement as Measurement,
        Presentation as Presentation,
        Scale as Scale,
    )
    from splatmill.schema.resources.models.selections import Selection as Selection, Stroke as Stroke
    from splatmill.schema.resources.shares import (
        LONGEST_SHARE as LONGEST_SHARE,
        CreateShare as CreateShare,
        Share as Share,
        SharedModel as SharedModel,
        ShareList as ShareList,
        ShareWithToken as ShareWithToken,
    )
    from splatmill.schema.resources.storage import (
        OwnerUse as OwnerUse,
        PlannedDeletion as PlannedDeletion,
        StorageUse as StorageUse,
        StoredBytes as StoredBytes,
        StoredKind as StoredKind,
        StoredRecord as StoredRecord,
    )
    from splatmill.schema.resources.webhooks import (
        CreateWebhook as CreateWebhook,
        Delivery as Delivery,
        DeliveryAttempt as DeliveryAttempt,
        DeliveryList as DeliveryList,
        DeliveryState as DeliveryState,
        Webhook as Webhook,
        WebhookEvent as WebhookEvent,
        WebhookList as WebhookList,
        WebhookPayload as WebhookPayload,
        WebhookWithSecret as WebhookWithSecret,
    )
    from splatmill.schema.videos import (
        CameraPath as CameraPath,
        Keyframe as Keyframe,
        OrbitRequest as OrbitRequest,
        Trace as Trace,
        TraceRequest as TraceRequest,
    )


if not TYPE_CHECKING:  # a type checker would take any name for one of this package

    def __getattr__(name: str) -> Any:
        if not name.startswith("_"):
            for module in walk_packages(__path__, f"{__name__}."):
                for each, value in vars(import_module(module.name)).items():
                    if not each.startswith("_") and not isinstance(value, ModuleType):
                        globals()[each] = value
        if name not in globals():
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return globals()[name]
