"""The last bundle adjustment of a model, with the lens parameters that its photos determine."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.callbacks import stop_if
from splatmill_worker.sfm.checks import implausible_intrinsics
from splatmill_worker.sfm.mapping.registered import registered
from splatmill_worker.sfm.options import FISHEYE

OPENCV_MIN_PHOTOS = 8
"""Registered photos of a camera from which its four OPENCV distortion coefficients are estimated."""

OPENCV_PARAMETERS = 4
"""Parameters that an OPENCV camera has more than a SIMPLE_RADIAL one: the ratio of its focal lengths, k2, p1 and p2
(decisions: OPENCV_PARAMETERS)."""

OPENCV_MIN_OBSERVATIONS = 2000
"""Observations of points by a camera, of those that take part, from which its four OPENCV distortion coefficients are
estimated."""

STRETCH_PIXELS = 1.0
"""Standard deviation of fx / fy, as a displacement of the longer edge of the photo in pixels, up to which the two focal
lengths are estimated apart: a larger stretch would be visible, and no lens has one (decisions: STRETCH_PIXELS)."""

FOCAL_DEVIATION = 0.05
"""Relative standard deviation up to which an estimated focal length is used. Beyond it noise biases the estimate too:
along a line it falls to half of the true one (decisions: FOCAL_DEVIATION)."""

PART = 250
"""Photos of which the covariance is estimated first: that of 250 takes 2 s, that of 1,000 takes 37 s."""

LEAST_TRACK = 3
"""Observations of a point in a part of the photos, at least; see `part_of`."""

MAX_ITERATIONS = 50
"""Iterations of the last bundle adjustment, at most."""

ITERATED_OBSERVATIONS = 2_000_000
"""Observations times iterations of one call of the solver: about four seconds of one core."""

LEAST_ITERATIONS = 3
"""Iterations of one call of the solver, at least."""

FIRST_RADIUS, LARGEST_RADIUS = 1e4, 1e16
"""Radius of the solver's trust region at first, and at most; Ceres's."""

FUNCTION_TOLERANCE = 1e-6
"""Relative decrease of the cost below which the last bundle adjustment has converged."""


@dataclass(frozen=True)
class Adjusted:
    """A model after its last bundle adjustment.

    model: poses, points and lenses.
    tied: cameras whose fx and fy are one value because their photos do not determine the ratio.
    assumed: cameras with their initial focal length because their photos do not determine it.
    """

    model: pycolmap.Reconstruction
    tied: frozenset[int] = frozenset()
    assumed: frozenset[int] = frozenset()


def adjust_with_lenses(
    model: pycolmap.Reconstruction,
    initial: Mapping[int, float],
    threads: int,
    cancelled: Callable[[], bool],
    on_iterations: Callable[[int], None] = lambda done: None,
    priors: Sequence[pycolmap.PosePrior] = (),
) -> Adjusted:
    """Adjust all poses and points, and of each SIMPLE_RADIAL camera the parameters that its photos determine.

    Parameters are judged by their standard deviations in the adjustment. A camera gets OPENCV distortion (k1, k2, p1,
    p2) and separate fx and fy where the ratio fx / fy is determined, since motion around one axis leaves a stretch of
    the scene along that axis nearly free, and where the observations ask for them: parameters that explain only noise
    bend a wide scene (decisions: OPENCV_PARAMETERS). Where not even the single focal length of SIMPLE_RADIAL is
    determined, as by parallel views of a plane or along a straight line, the initial one is kept.

    model: is not changed.
    initial: focal length that a camera had before any photo was matched, in pixels, by its id.
    on_iterations: as that of `bundle_adjust`, which is called up to three times.
    priors: as those of `bundle_adjust`.
    """
    adjust = partial(
        bundle_adjust, threads=threads, priors=priors, cancelled=cancelled, on_iterations=on_iterations
    )
    model = registered(model)  # the covariance needs the pose of every photo
    rich = _well_observed(model, "SIMPLE_RADIAL")
    tied: set[int] = set()
    simple = adjust(model)
    while rich:
        trial = copy.deepcopy(model)
        _use_opencv(trial, rich)
        cost = adjust(trial)
        deviations = Deviations(trial)
        loose = {camera for camera in rich if not deviations.stretch_is_determined(camera)}
        del deviations
        if not loose:
            pays = explains_more(
                simple, cost, trial.compute_num_observations(), OPENCV_PARAMETERS * len(rich)
            )
            if pays and implausible_intrinsics(trial) is None:
                return Adjusted(trial, frozenset(tied))
            break
        tied |= loose
        rich -= loose
    deviations = Deviations(model)
    assumed = {camera for camera in initial if not deviations.focal_is_determined(camera)}
    del deviations
    if assumed:
        for camera in assumed:
            params = np.array(model.cameras[camera].params)
            params[model.cameras[camera].focal_length_idxs()] = initial[camera]
            model.cameras[camera].params = params.tolist()
        adjust(model, fixed_focal=True)
    return Adjusted(model, frozenset(tied), frozenset(assumed))


def explains_more(cost: float, less: float, observations: int, parameters: int) -> bool:
    """Whether a model with more parameters explains the observations better than by fitting their noise.

    By the criterion of Schwarz, "Estimating the dimension of a model" (1978), for residuals of unknown variance: two of
    each observation.

    cost, less: of the adjustments without and with them. parameters: how many there are more.
    """
    residuals = 2 * observations
    if not 0.0 < less < cost:
        return False
    return residuals * math.log(cost / less) > parameters * math.log(residuals)


def iterations_at_once(model: pycolmap.Reconstruction, most: int) -> int:
    """Iterations of one call of the solver, of `most` in all.

    COLMAP holds Python's lock while it solves, so that nothing is reported and nobody can cancel meanwhile.
    """
    observations = max(1, model.compute_num_observations())
    return min(most, max(LEAST_ITERATIONS, ITERATED_OBSERVATIONS // observations))


def radius_after(radius: float, good: int, bad: int) -> float:
    """An estimate of the radius of the trust region after so many good and bad steps of the solver.

    A good step triples it at most, and the first bad one after it halves it. It is not taken for less than the first
    radius. A call that began anew with that one would keep what observations hardly determine, such as the bulge of a
    wide scene, from moving at all; one that begins with too large a radius makes a few bad steps.
    """
    return float(np.clip(radius * 3.0**good / 2.0**bad, FIRST_RADIUS, LARGEST_RADIUS))


def update_errors(model: pycolmap.Reconstruction) -> None:
    """Update the reprojection errors of the points, in place, without observations of points behind the camera.

    The solver counts nothing for those, and so may move a point there; COLMAP's error of one is 1e154 pixels.
    """
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    model.update_point_3d_errors()


def median_error(model: pycolmap.Reconstruction) -> float:
    """Median over the points of the mean reprojection error that they hold, in pixels; infinite without points."""
    return float(np.median([point.error for point in model.points3D.values()] or [math.inf]))


def use_opencv_fisheye(model: pycolmap.Reconstruction) -> None:
    """Give the fisheye cameras with enough photos and observations the distortion k1 to k4, in place."""
    for camera_id in _well_observed(model, FISHEYE):
        camera = model.cameras[camera_id]
        focal, cx, cy, k1 = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE
        camera.params = [focal, focal, cx, cy, k1, 0.0, 0.0, 0.0]


def _well_observed(model: pycolmap.Reconstruction, name: str) -> set[int]:
    """Cameras of a model with enough photos and observations for more distortion (decisions: OPENCV_CAMERAS)."""
    photos: dict[int, int] = {}
    observations: dict[int, int] = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        photos[image.camera_id] = photos.get(image.camera_id, 0) + 1
        observations[image.camera_id] = observations.get(image.camera_id, 0) + image.num_points3D
    return {
        camera_id
        for camera_id, camera in model.cameras.items()
        if camera.model.name == name
        and photos.get(camera_id, 0) >= OPENCV_MIN_PHOTOS
        and observations[camera_id] >= OPENCV_MIN_OBSERVATIONS
    }


def _use_opencv(model: pycolmap.Reconstruction, cameras: Collection[int]) -> None:
    for camera_id in cameras:
        camera = model.cameras[camera_id]
        focal, cx, cy, k1 = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [focal, focal, cx, cy, k1, 0.0, 0.0, 0.0]


class Deviations:
    """Standard deviations of the lens parameters at the solution of a bundle adjustment of all that it may change.

    The covariance of many photos takes long, and as much memory as the square of their number. So a part of them is
    asked first whether it determines a parameter. What it does, all of them do: they have more observations at the
    same solution. Where it does not, all are asked, without a report of progress.

    error: median over the points of the mean reprojection error, in pixels; infinite without points.
    """

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self._model, self.error = model, median_error(model)

    def stretch_is_determined(self, camera_id: int) -> bool:
        """Whether the ratio fx / fy of an OPENCV camera is known to STRETCH_PIXELS."""
        return any(self._stretch(each, camera_id) <= STRETCH_PIXELS for each in self._estimates())

    def focal_is_determined(self, camera_id: int) -> bool:
        """Whether the focal length of a camera is known to FOCAL_DEVIATION."""
        return any(self._focal(each, camera_id) <= FOCAL_DEVIATION for each in self._estimates())

    def focal(self, camera_id: int) -> float:
        """The relative standard deviation of the focal length, a camera's first parameter; infinite if it is free."""
        return self._focal(self._whole, camera_id)

    def _estimates(self) -> Iterator[Estimate]:
        # A part has a photo of each camera, so that of many cameras it is hardly smaller.
        if self._model.num_reg_images() > PART >= 2 * len(self._model.cameras):
            yield self._part
        yield self._whole

    @cached_property
    def _whole(self) -> Estimate:
        return Estimate.of(self._model)

    @cached_property
    def _part(self) -> Estimate:
        return Estimate.of(part_of(self._model, PART))

    def _stretch(self, estimate: Estimate, camera_id: int) -> float:
        """Standard deviation of fx / fy, as a displacement of the longer edge of the photo in pixels."""
        covariance = estimate.covariance_of(camera_id)
        if covariance is None:
            return math.inf
        camera = self._model.cameras[camera_id]
        gradient = np.array([1.0, -1.0]) / camera.params[:2]
        deviation = self.error * math.sqrt(gradient @ covariance[:2, :2] @ gradient)
        return deviation * max(camera.width, camera.height) / 2

    def _focal(self, estimate: Estimate, camera_id: int) -> float:
        covariance = estimate.covariance_of(camera_id)
        if covariance is None:
            return math.inf
        return float(self.error * math.sqrt(covariance[0, 0]) / self._model.cameras[camera_id].params[0])


@dataclass(frozen=True)
class Estimate:
    """The covariance of a model's parameters, of residuals of one pixel; None where it is singular."""

    model: pycolmap.Reconstruction
    covariance: pycolmap.BACovariance | None

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> Estimate:
        problem = _problem(model, _options(1))
        return cls(model, pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, problem))

    def covariance_of(self, camera_id: int) -> np.ndarray | None:
        """That of a camera's parameters; None where it is not finite, or the model does not have the camera."""
        if self.covariance is None or camera_id not in self.model.cameras:
            return None
        # COLMAP finds the parameters of a camera by their address, which the view `params` keeps.
        block = self.covariance.get_other_params_cov(self.model.cameras[camera_id].params)
        return block if block is not None and np.isfinite(block).all() else None


def part_of(model: pycolmap.Reconstruction, most: int) -> pycolmap.Reconstruction:
    """A copy with about `most` of the registered photos: of each camera the same number, in order of their ids.

    Points that only two of these observe are left out: where their rays are nearly parallel, they make the covariance
    infinite.
    """
    of_camera: dict[int, list[int]] = {}
    for image_id in sorted(model.reg_image_ids()):
        of_camera.setdefault(model.images[image_id].camera_id, []).append(image_id)
    kept = {image for images in of_camera.values() for image in images[: max(1, most // len(of_camera))]}
    part = copy.deepcopy(model)
    for image_id in model.reg_image_ids():
        if image_id not in kept:
            part.deregister_frame(part.images[image_id].frame_id)
    for point_id in [
        point_id for point_id, point in part.points3D.items() if point.track.length() < LEAST_TRACK
    ]:
        part.delete_point3D(point_id)
    return registered(part)


def bundle_adjust(
    model: pycolmap.Reconstruction,
    threads: int,
    *,
    fixed_cameras: bool = False,
    fixed_intrinsics: bool = False,
    fixed_focal: bool = False,
    priors: Sequence[pycolmap.PosePrior] = (),
    cancelled: Callable[[], bool],
    on_iterations: Callable[[int], None] = lambda done: None,
) -> float:
    """Adjust all poses, points and lenses (unless fixed) to convergence, with a robust loss, in place.

    Returns the cost: half of the sum of the losses.

    fixed_cameras: keep poses, focal lengths and distortion.
    fixed_intrinsics: keep focal lengths and distortion.
    fixed_focal: keep focal lengths.
    priors: positions of photos that are observations too, in the world of `model`.
    on_iterations: called with the number of iterations so far, every few seconds in a large model.

    Raises Cancelled between iterations, as often, when the caller has asked to stop.
    """
    options = _options(threads)
    options.refine_rig_from_world = not fixed_cameras
    options.refine_extra_params = not fixed_cameras and not fixed_intrinsics
    options.refine_focal_length = options.refine_extra_params and not fixed_focal
    at_once = iterations_at_once(model, MAX_ITERATIONS)
    options.ceres.solver_options.max_num_iterations = at_once
    radius, cost = FIRST_RADIUS, 0.0
    for done in range(0, MAX_ITERATIONS, at_once):
        on_iterations(done)
        stop_if(cancelled)
        options.ceres.solver_options.initial_trust_region_radius = radius
        problem = _problem_with(priors, model, options) if priors else _problem(model, options)
        solved = problem.solve()
        del problem  # before the next one is built
        if not isinstance(solved, pycolmap.CeresBundleAdjustmentSummary):  # there is nothing to adjust
            break
        steps = solved.ceres_summary
        cost = steps.final_cost
        if solved.termination_type != pycolmap.BundleAdjustmentTerminationType.NO_CONVERGENCE:
            break
        good = steps.num_successful_steps - 1  # the first one is where it begins
        if good and steps.initial_cost - steps.final_cost <= FUNCTION_TOLERANCE * steps.initial_cost:
            break
        radius = radius_after(radius, good, steps.num_unsuccessful_steps)
    update_errors(model)
    stop_if(cancelled)
    return cost


def _options(threads: int) -> pycolmap.BundleAdjustmentOptions:
    """Those of an adjustment of poses, points and lenses."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = False
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
    options.ceres.min_num_residuals_for_cpu_multi_threading = 5000
    return options


def _all_photos(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    return config


def _problem(
    model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions
) -> pycolmap.CeresBundleAdjuster:
    """The problem of an adjustment of all photos."""
    config = _all_photos(model)
    # Fixes the seven degrees of gauge freedom, as `pycolmap.bundle_adjustment` does; that function also logs.
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _problem_with(
    priors: Sequence[pycolmap.PosePrior],
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
) -> pycolmap.CeresBundleAdjuster:
    """The problem of an adjustment of all photos with `priors`, which take the place of a fixed gauge.

    COLMAP shifts the model when it builds this problem and back when it has solved it, so it can be solved once.
    """
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.alignment_ransac.random_seed = 0
    return pycolmap.create_pose_prior_ceres_bundle_adjuster(
        options, prior_options, _all_photos(model), list(priors), model
    )
