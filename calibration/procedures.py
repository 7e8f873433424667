"""All calibration procedures, in the order in which a bench is calibrated."""

from calibration.backlash import Backlash as Backlash
from calibration.cable import Cable as Cable
from calibration.camera_model import CameraModel as CameraModel
from calibration.camera_time import CameraTime as CameraTime
from calibration.encoder import Encoder as Encoder
from calibration.gyro_rotation import GyroRotation as GyroRotation
from calibration.gyro_scale import GyroScale as GyroScale
from calibration.home_mark import HomeMark as HomeMark
from calibration.imu_mounting import ImuMounting as ImuMounting
from calibration.procedure import Procedure
from calibration.repeatability import Repeatability as Repeatability
from calibration.ringing import Ringing as Ringing
from calibration.table_axis import TableAxis as TableAxis

PROCEDURES: tuple[type[Procedure], ...] = (
    Cable,
    Backlash,
    Encoder,
    GyroScale,
    ImuMounting,
    GyroRotation,
    Ringing,
    CameraModel,
    TableAxis,
    HomeMark,
    CameraTime,
    Repeatability,
)
