"""Checks frames that were taken while the table rotated, as `rig.views.capture` does for frames at rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.config import RigConfig
from rig.devices.camera import CameraLocks
from rig.motion.scan_speed import smear_px, time_sigma_ms
from rig.motion.trajectory import Trajectory
from rig.views.capture import Attempt, ImageQuality, MotionEvidence, RejectReason, ViewEvidence
from rig.views.stream import StreamFrame, after_middle_row_ns, irregular_stamps, middle_ns


@dataclass(frozen=True, slots=True)
class FlightFrameCheck:
    """Checks the frames of one motion.

    Attributes
    ----------
    locks
        The camera's settings at the beginning; they must not have changed (``locks_hold``).
    begun_ns
        When the motion began.
    period_s
        Time between two frames.
    """

    config: RigConfig
    locks: CameraLocks
    locks_hold: bool
    begun_ns: int
    period_s: float

    def irregular(self, stamps_ns: Sequence[int]) -> NDArray[np.bool_]:
        """Return which time stamps of consecutive frames cannot be trusted, bool (n,)."""
        return irregular_stamps(stamps_ns, self.period_s, self.config.camera_time.jitter_ms)

    def attempt(self, frame: StreamFrame, trajectory: Trajectory, *, irregular: bool) -> Attempt:
        """Return a frame as an attempt at a view: its evidence, and the reasons to reject it."""
        quality = ImageQuality.of(frame.image_bgr, self.config.view)
        middle = middle_ns(frame.stamp_ns, self.config.camera_time)
        motion = trajectory.at([middle])
        speed_dps = abs(float(motion.rate_dps[0]))
        time_deg = speed_dps * time_sigma_ms(self.config) * 1e-3
        evidence = MotionEvidence(
            middle,
            float(motion.angle_deg[0]),
            float(np.hypot(motion.sigma_deg[0], time_deg)),
            speed_dps,
            smear_px(self.config, speed_dps),
            trajectory.residual_deg,
        )
        reasons = []
        if irregular or not frame.stamped:
            reasons.append(RejectReason.TIME_UNCERTAIN)
        if evidence.angle_sigma_deg > self.config.view.max_angle_sigma_deg or not trajectory.consistent:
            reasons.append(RejectReason.ANGLE_UNCERTAIN)
        if evidence.smear_px > 1.1 * self.config.view.max_smear_px:  # the speed varies about the chosen one
            reasons.append(RejectReason.SMEARED)
        if frame.repeated:
            reasons.append(RejectReason.REPEATED_FRAME)
        if not self.locks_hold:
            reasons.append(RejectReason.LOCKS_CHANGED)
        reasons += quality.reasons(self.config.view)
        return Attempt(
            1,
            frame.image_bgr,
            ViewEvidence(
                settled_ns=self.begun_ns,
                exposed_ns=frame.stamp_ns,
                sharpness=quality.sharpness,
                mean_level=quality.mean_level,
                dark_share=quality.dark_share,
                saturated_share=quality.saturated_share,
                repeated=frame.repeated,
                locks=self.locks,
                locks_hold=self.locks_hold,
                stillness=None,
                motion=evidence,
            ),
            tuple(reasons),
        )

    def at_the_object(
        self, attempt: Attempt, segmentation: Mapping[str, Any] | None, trajectory: Trajectory
    ) -> Attempt:
        """Return an attempt with the time and angle of the object's middle row, not the frame's (rolling shutter).

        ``segmentation`` is that of the attempt's image; without a box of the object nothing changes.
        """
        motion, box = attempt.evidence.motion, (segmentation or {}).get("box_px")
        if motion is None or box is None:
            return attempt
        middle_ns = motion.middle_ns + after_middle_row_ns(self.config, box)
        angle_deg = float(trajectory.at([middle_ns]).angle_deg[0])
        motion = replace(motion, middle_ns=middle_ns, angle_deg=angle_deg)
        return replace(attempt, evidence=replace(attempt.evidence, motion=motion))
