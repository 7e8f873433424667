"""All calibration procedures, in the order in which a bench is calibrated."""

from calibration.backlash import Backlash
from calibration.cable import Cable
from calibration.camera_light import CameraCard, CameraNoise
from calibration.camera_model import CameraModel
from calibration.encoder import Encoder
from calibration.gyro_noise import GyroNoise
from calibration.gyro_rotation import GyroRotation
from calibration.gyro_scale import GyroScale
from calibration.imu_mounting import ImuMounting
from calibration.motion_model import MotionModel
from calibration.procedure import Procedure
from calibration.repeatability import Repeatability
from calibration.table_axis import TableAxis

PROCEDURES: tuple[type[Procedure], ...] = (
    Cable,
    Backlash,
    Encoder,
    MotionModel,
    GyroScale,
    ImuMounting,
    GyroNoise,
    GyroRotation,
    CameraNoise,
    CameraCard,
    CameraModel,
    TableAxis,
    Repeatability,
)

__all__ = [
    "PROCEDURES",
    "Backlash",
    "Cable",
    "CameraCard",
    "CameraModel",
    "CameraNoise",
    "Encoder",
    "GyroNoise",
    "GyroRotation",
    "GyroScale",
    "ImuMounting",
    "MotionModel",
    "Repeatability",
    "TableAxis",
]
