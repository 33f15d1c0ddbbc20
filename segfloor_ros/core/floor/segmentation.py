"""The floor segmentation stage: a rectified stereo pair in, the floor out.

What moves and the border that rectification leaves do not count.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import BlankBorder, union
from segfloor_ros.core.contracts import (
    FLOOR,
    MOVING,
    NO_EVIDENCE,
    NOT_FLOOR,
    FloorObservation,
    FloorScan,
    Mount,
)
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.floor.disparity.matching import BLOCK_PX, TwoScaleMatcher, disparity_range
from segfloor_ros.core.floor.disparity.profile import (
    STEP_PX,
    FloorView,
    column_step,
    filtered_v_disparity,
    first_floor_row,
    fit_profile,
    last_fine_row,
    pixels_where,
)
from segfloor_ros.core.floor.mask.filling import (
    NetworkFloor,
    blank_feet,
    drop_islands,
    fill_gaps,
    fill_regions,
    trim_to_edges,
)
from segfloor_ros.core.floor.mask.likelihood import Likelihood, Seen
from segfloor_ros.core.floor.mask.look import unlike_floor
from segfloor_ros.core.floor.mask.painting import with_floor, without_floor
from segfloor_ros.core.floor.mask.pixel_evidence import (
    FrameEvidence,
    Heights,
    below_floor,
    compare,
    judge,
)
from segfloor_ros.core.floor.pair import Pair
from segfloor_ros.core.floor.plane.plane import PROVED, Fixture, expectations, plane_of_frame
from segfloor_ros.core.floor.scan import FloorScanner, OverheadMatcher
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.timing import NoTimes, StageTimes

DISPARITY, DISPARITY_ABOVE = 'disparity', 'disparity above the horizon'
_BORDER_BLOCKS = 2
"""So near to the border of the right image, in blocks that are matched, matches are unsure."""
_LEAST_SHARE = 0.5
"""What has a smaller share of the texture that a floor needs shows noise, and stands nowhere."""
_BOARD = 2
"""Table tops are thinner than what stands: so many times what is seen of them counts."""


class FloorSegmentation:
    """Finds the floor in rectified stereo pairs of one camera. times: gets what each step takes.
    network: how far what a network says of the floor can be believed.
    """

    def __init__(
        self,
        camera: StereoCamera,
        settings: FloorSegmentationSettings,
        times: StageTimes | None = None,
    ) -> None:
        self._times = times or NoTimes()
        self._camera = camera
        self._settings = settings
        self.network = NetworkFloor()
        self.likelihood = Likelihood()
        self._border = BlankBorder()
        self._mount: Mount | None = None
        self.fixture = Fixture()

    def process(
        self,
        left: NDArray[np.uint8],
        right: NDArray[Any],
        mount: Mount,
        T_map_base: Array | None = None,
        moving: NDArray[np.uint8] | None = None,
        said: NDArray[np.uint8] | None = None,
    ) -> FloorObservation:
        """Return the floor of a rectified grey pair (H, W) uint8; of a depth camera, right is its
        disparity (H, W) float32.

        mount: where the left camera sits above the floor. T_map_base: pose (4, 4) of the base in
        the map, where known: the floor may be level there. moving: mask
        (H, W) of the left image, 255 where something moves: it is neither floor nor in the way, and
        what it hides is unknown. The black border that rectification leaves is treated alike. said:
        (H, W) uint8, what a network says of the left image: `FLOOR`; `NOT_FLOOR`, what stands there
        whatever its depth; `MOVING`, or `NO_EVIDENCE`.
        """
        measure = self._times.measure
        self._prepare(mount)
        expected = expectations(mount, T_map_base)
        expected = np.vstack([expected, self.fixture.usual(expected[0])])
        with measure('texture'):
            part = self._part(mount, expected)
            hidden = union(moving, self._border.see(left))
            pair = Pair.of(left, right, hidden, said, part)
        with measure(DISPARITY):
            disparity, movable = self._disparities(pair)
            below = disparity[part]
        with measure('plane'):
            angles_height, is_shown = self._plane(pair, below, expected)
        view = FloorView.of(self._camera, _with_angles(mount, angles_height), pair.first_row)
        with measure('profile'):
            clear, searched = pair.texture > 2 * pair.enough, self._matcher.num_disparities
            counted = filtered_v_disparity(view, below, clear, searched)
            profile = fit_profile(counted, view.line, self._camera)
        with measure('comparison'):
            heights = Heights.of(view, profile, pair, below, searched, self._settings)
            compared = compare(view, profile, pair, below, heights)
            frame = FrameEvidence(view, profile, pair, below, heights, compared)
        with measure('evidence'):
            judged, odd = _judged(frame)
        with measure('filling'):
            mask = self._fill(frame, judged, odd)
        with measure('likelihood'):
            seen = _seen(frame, mask, self._settings.step_height_m)
            mask, climbed = self.likelihood.weighed(mask, seen)
            driven = with_floor(mask, climbed)
            if not is_shown:
                driven[driven == FLOOR] = NO_EVIDENCE
            driven = pair.without_hidden(driven)
            mask = drop_islands(without_floor(driven, climbed))
        with measure(DISPARITY_ABOVE):
            hanging_xy = self._overhead.positions(pair, view.mount)
        with measure('scan'):
            movable_xy = None if movable is None else self._positions(view, movable)
            scan = self._scan(frame, judged, driven, hanging_xy, movable_xy)
        if movable is not None:
            disparity = np.maximum(disparity, movable)
        return FloorObservation(
            disparity_px=disparity,
            mask=_whole(view, mask),
            profile_px=profile.at_rows(np.arange(self._camera.height)).astype(np.float64),
            scan=scan,
            max_disparity_px=max(float(searched), float(disparity.max())),
            v_disparity=counted,
        )

    @property
    def remarks(self) -> dict[str, str]:
        """What is wrong with the mount and with what a network says, in words, by what it is."""
        said = ('fixture', self.fixture.problem), ('network', self.network.remark)
        return {about: words for about, words in said if words}

    def _part(self, mount: Mount, expected: Array) -> tuple[slice, slice]:
        """Return the rows and columns of the image that are looked at."""
        first_row = min(first_floor_row(self._camera, _with_angles(mount, one)) for one in expected)
        return np.s_[first_row:, :: column_step(self._camera)]

    def _disparities(self, pair: Pair) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the disparity (H, W) of what counts, and that of what a network says moves."""
        disparity = self._matched(pair) if pair.measured is None else pair.measured
        movable = None
        if pair.said is not None:
            movable = np.where(pair.said == MOVING, disparity, np.float32(0))
            disparity[pair.said == NOT_FLOOR] = 0
        if pair.moving is not None:
            disparity[pair.moving > 0] = 0
        return disparity, movable

    def _plane(self, pair: Pair, below: NDArray[np.float32], expected: Array) -> tuple[Array, bool]:
        """Return pitch, roll and height (3,) of the camera, and whether the floor may be there: of
        a camera that is not fixed to its base only where the image proves it.
        """
        is_fixed = self.fixture.problem is None
        looked = self._camera, pair.first_row, below, pair.texture, pair.enough, expected
        fit = plane_of_frame(*looked, is_fixed)
        is_proved = fit.evidence > PROVED
        is_lost = is_fixed and not is_proved
        self.fixture.note(plane_of_frame(*looked, is_fixed=False) if is_lost else fit)
        return fit.angles_height, is_fixed or is_proved

    def change_settings(self, settings: FloorSegmentationSettings) -> None:
        """Segment with changed settings from now on."""
        self._settings = settings
        if self._mount is not None:
            self._make_tools(self._mount)

    def _prepare(self, mount: Mount) -> None:
        if mount == self._mount:
            return
        if mount.up_in_camera[1] >= 0:
            pitch_deg, roll_deg = np.degrees([mount.pitch_rad, mount.roll_rad])
            raise CalibrationError(
                f'pitch {pitch_deg:.0f} deg, roll {roll_deg:.0f} deg: down is up in the image; '
                'turn both images by 180 deg, exchange left and right, and turn the mount'
            )
        self._make_tools(mount)
        self._mount, self.fixture = mount, Fixture()

    def _make_tools(self, mount: Mount) -> None:
        searched = disparity_range(self._camera, mount)
        self._matcher = TwoScaleMatcher(-(-searched // 16) * 16)
        self._overhead = OverheadMatcher(self._camera, searched, self._settings)
        self._scanner = FloorScanner(self._camera, mount, self._settings)

    def _matched(self, pair: Pair) -> NDArray[np.float32]:
        top = pair.first_row
        assert self._mount is not None
        fine_rows = last_fine_row(self._camera, self._mount) - top
        disparity = np.zeros(pair.left.shape, np.float32)
        disparity[top:] = self._matcher.compute(pair.left[top:], pair.right[top:], fine_rows)
        return disparity

    def _fill(
        self, frame: FrameEvidence, mask: NDArray[np.uint8], looks_odd: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """Return the mask with floor where this pair of images alone cannot tell: where it looks
        like floor. What is filled first lets more be filled, so this is done twice. Where a network
        was right so far, what it calls floor is floor, too, if the images do not deny it.
        """
        view, pair, consistent = frame.view, frame.pair, frame.compared.consistent
        for _ in range(2):
            mask = fill_regions(frame, mask, looks_odd)
            mask = fill_gaps(view, frame.profile, mask, consistent & ~looks_odd)
        if pair.said_there is not None:
            self.network.note(pair.said_there, mask)
            if self.network.is_trusted:
                mask = with_floor(mask, (pair.said_there == FLOOR) & consistent)
        return mask

    def _scan(
        self,
        frame: FrameEvidence,
        judged: NDArray[np.uint8],
        mask: NDArray[np.uint8],
        hanging_xy: NDArray[np.float32],
        movable_xy: NDArray[np.float32] | None,
    ) -> FloorScan:
        """Return the scan. judged, mask: (R, W), before and after what is blank was filled.
        hanging_xy, movable_xy: (2, N), what is in the way above the horizon,
        and what is of a class that moves.
        """
        view, pair = frame.view, frame.pair
        above = (frame.heights.height > 0) & (pair.texture >= _LEAST_SHARE * pair.enough)
        rows, columns = pixels_where(((judged == NOT_FLOOR) & above)[::2])
        rows *= 2
        upright_xy = view.positions(rows, columns, frame.disparity_px[rows, columns])
        v, u, floor_px = view.pixels_of_profile(self._scanner.cells_xy, frame.profile)
        floor = (v >= 0) & (v < mask.shape[0]) & (u >= 0) & (u < mask.shape[1])
        floor &= mask.take(v * np.int32(mask.shape[1]) + u, mode='clip') == FLOOR
        shared = u * view.step >= floor_px + np.float32(_BORDER_BLOCKS * BLOCK_PX)
        # At half the resolution a pixel tells of four, here of two or, in every other column, four.
        upright_xy = np.hstack([upright_xy, np.repeat(hanging_xy, _BOARD * 2 // view.step, axis=1)])
        feet_xy, density = _feet(frame, mask), 1 / (2 * view.step)
        return self._scanner.scan(floor, shared, upright_xy, feet_xy, density, movable_xy)

    def _positions(self, view: FloorView, disparity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return where in the base's x-y plane a disparity (H, W) shows something, (2, N); as
        many pixels tell as of what stands.
        """
        rows, columns = pixels_where(disparity[::2, :: view.step] > 0)
        uv_px = np.stack([columns * view.step, rows * 2], axis=1)
        at = disparity[uv_px[:, 1], uv_px[:, 0]]
        return self._overhead.in_the_way(uv_px.astype(float), at.astype(float), view.mount)


def _judged(frame: FrameEvidence) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return a mask (R, W) of what the pixels of a frame say by themselves, cut back to edges, and
    of what a network says stands there; and what does not look like floor (R, W).
    """
    pair = frame.pair
    mask = trim_to_edges(judge(frame), pair.slope)
    odd = unlike_floor(pair.left[pair.part], mask == FLOOR)
    # What stands may look like that, and what is measured to be floor stays so.
    doubtful = (mask == FLOOR) & odd
    mask = without_floor(mask, doubtful)
    mask = with_floor(mask, doubtful & ~frame.heights.mean_off & below_floor(mask))
    mask = pair.without_hidden(mask)
    if pair.said_there is not None:
        mask[pair.said_there == NOT_FLOOR] = NOT_FLOOR
    return mask, odd


def _seen(frame: FrameEvidence, mask: NDArray[np.uint8], step_m: float) -> Seen:
    """Return what the likelihood weighs. mask: (R, W), with what is floor so far."""
    pair, heights, compared, half = frame.pair, frame.heights, frame.compared, frame.view.half
    grey = cv2.blur(pair.left_rows, (BLOCK_PX, BLOCK_PX))[::STEP_PX, ::STEP_PX]
    return Seen(
        floor_px=compared.floor_px,
        disparity_px=frame.disparity_px[half],
        slope=frame.view.line.slope,
        texture=pair.texture[half] / pair.enough,
        lower=(heights.off & ~heights.above)[half],
        left_only=frame.view.columns[half[1]] < compared.floor_px,
        grey=grey.astype(np.float32),
        noise_grey=pair.noise_grey if pair.measured is None else 0.0,
        step=step_m / max(frame.view.mount.height_m - step_m, step_m),
        mask=mask[half],
    )


def _feet(frame: FrameEvidence, mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return where blank faces stand, and what a network says stands, whatever its depth: its
    lowest pixel in each column, unless the image ends; (2, N) in the base's x-y plane.
    """
    view, said = frame.view, frame.pair.said_there
    rows, columns = blank_feet(frame, mask)
    if said is not None:
        stands = said[::-1] == NOT_FLOOR
        lowest = len(said) - 1 - stands.argmax(axis=0)
        found = np.flatnonzero(stands.any(axis=0) & ~stands[0])
        rows, columns = np.append(rows, lowest[found]), np.append(columns, found)
    derolled = rows + view.shear_px[columns] + view.first_row
    floor_px = frame.profile.at_rows(derolled).astype(np.float32)
    is_below = floor_px > 0
    return view.positions(rows[is_below], columns[is_below], floor_px[is_below])


def _whole(view: FloorView, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the mask (H, W) of the image: nothing above the horizon is floor, but on a bump the
    floor may reach higher than was looked for.
    """
    whole = np.full((view.camera.height, view.camera.width), NOT_FLOOR, np.uint8)
    whole[max(0, int(view.line.horizon)) : view.first_row] = NO_EVIDENCE
    whole[view.first_row :] = np.repeat(mask, view.step, axis=1)[:, : view.camera.width]
    return whole


def _with_angles(mount: Mount, angles_height: Array) -> Mount:
    pitch, roll, height = (float(value) for value in angles_height)
    return dataclasses.replace(mount, height_m=height, pitch_rad=pitch, roll_rad=roll)
