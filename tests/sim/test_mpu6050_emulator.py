"""The simulated MPU-6050, register by register, through the real smbus2."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from smbus2 import SMBus, i2c_msg

from sim.i2c import SimI2cBus
from sim.imu.inertial import InertialModel
from sim.imu.mpu6050 import BANDWIDTH_HZ, SimMpu6050
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.world import World
from tests.fuzzing import examples

AT = 0x68
DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, FIFO_EN, INT_STATUS = 0x19, 0x1A, 0x1B, 0x1C, 0x23, 0x3A
DATA, USER_CTRL, PWR, COUNT, FIFO, WHO = 0x3B, 0x6A, 0x6B, 0x72, 0x74, 0x75


class Chip:
    """One sensor, its world, and a master that reads registers."""

    def __init__(self, noise: NoiseModel | None = None, seed: int = 0) -> None:
        self.world = World(noise=noise or NoiseModel.none(), seed=seed)
        self.sensor = SimMpu6050(self.world)
        self.bus = SimI2cBus(self.world.clock)
        self.bus.attach(AT, self.sensor)
        self.master = SMBus(self.bus.path)

    def close(self) -> None:
        self.master.close()
        self.bus.close()

    def __enter__(self) -> "Chip":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def get(self, register: int, count: int = 1) -> list[int]:
        return self.master.read_i2c_block_data(AT, register, count)

    def set(self, register: int, *values: int) -> None:
        self.master.write_i2c_block_data(AT, register, list(values))

    def words(self, register: int = DATA, count: int = 7) -> list[int]:
        return np.frombuffer(bytes(self.get(register, 2 * count)), ">i2").tolist()

    def count(self) -> int:
        return int.from_bytes(bytes(self.get(COUNT, 2)), "big")

    def drain(self, count: int | None = None) -> bytes:
        answer = i2c_msg.read(AT, self.count() if count is None else count)
        self.master.i2c_rdwr(i2c_msg.write(AT, [FIFO]), answer)
        return bytes(answer)

    def wake(self, *, divider: int = 5, dlpf: int = 3, fifo: int = 0) -> None:
        self.set(PWR, 0x01)
        self.set(DIV, divider - 1, dlpf)
        self.set(FIFO_EN, fifo)
        self.set(USER_CTRL, 0x04)
        self.set(USER_CTRL, 0x40)

    def wait(self, seconds: float) -> None:
        self.world.clock.sleep(seconds)

    def rotate(self, dps: float) -> None:
        now_s = self.world.clock.now_ns() * 1e-9
        self.world.drive(to_velocity(now_s, 0.0, dps, dps, 1.0))


@pytest.fixture
def chip() -> Iterator[Chip]:
    with Chip() as c:
        yield c


@given(register=st.integers(0, 0x7F), value=st.integers(0, 255))
@examples(35)
def test_only_the_writable_bits_of_writable_registers_change(register: int, value: int) -> None:
    kept = {DIV: 0xFF, CONFIG: 0x3F, GYRO_CONFIG: 0xF8, ACCEL_CONFIG: 0xF8, FIFO_EN: 0xFF, USER_CTRL: 0x70, PWR: 0x6F}
    sensor = SimMpu6050(World(noise=NoiseModel.none()))

    def dump() -> bytes:
        sensor.start(reading=False)
        sensor.write(b"\0")
        return sensor.read(FIFO)  # all up to FIFO_R_W, where the pointer stays

    before = dump()
    sensor.start(reading=False)
    sensor.write(bytes([register, value]))
    after = dump()
    if register == PWR and value & 0x80:
        assert after == before
        return
    others = [r for r in range(FIFO) if r != register and after[r] != before[r]]
    assert others == []
    if register in kept:
        assert after[register] == value & kept[register]
    elif 0x3A <= register <= 0x60 or register >= 0x72:
        assert register >= FIFO or after[register] == before[register]


@given(
    divider=st.integers(1, 256),
    dlpf=st.integers(0, 7),
    fifo=st.integers(0, 31).map(lambda bits: bits << 3),
    wait_ms=st.integers(1, 80),
)
@examples(10)
def test_fifo_fills_at_the_sample_rate_with_the_chosen_words(divider: int, dlpf: int, fifo: int, wait_ms: int) -> None:
    words = 3 * bool(fifo & 0x08) + sum(bool(fifo & bit) for bit in (0x80, 0x40, 0x20, 0x10))
    with Chip() as chip:
        chip.wake(divider=divider, dlpf=dlpf, fifo=fifo)
        epoch_ns = chip.world.clock.now_ns()  # FIFO_RESET and FIFO_EN came within the first sample, or after it
        chip.wait(wait_ms * 1e-3)
        samples = (chip.world.clock.now_ns() - epoch_ns) / 1e9 * (8000 if dlpf in (0, 7) else 1000) / divider
        assert chip.count() == pytest.approx(min(2 * words * samples, 1024), abs=2 * words * 4)


def test_fifo_frames_follow_the_order_of_the_data_registers(chip: Chip) -> None:
    chip.wake(fifo=0xF8)
    chip.rotate(100.0)
    chip.wait(0.1)
    frames = np.frombuffer(chip.drain(), ">i2").reshape(-1, 7)
    assert frames[-1].tolist() == chip.words() == [0, 0, 16384, round((25 - 36.53) * 340), 0, 0, 13100]


def test_overflowing_fifo_drops_the_oldest_bytes_and_sets_its_flag(chip: Chip) -> None:
    chip.wake(divider=1, fifo=0x70)
    chip.wait(0.12)
    assert chip.get(INT_STATUS) == [0x01]
    assert chip.get(INT_STATUS)[0] & 0x10 == 0
    chip.rotate(50.0)
    chip.wait(0.1)
    assert chip.get(INT_STATUS) == [0x11]
    assert chip.get(INT_STATUS)[0] & 0x10 == 0  # reading cleared it
    assert chip.count() == 1024
    newest = np.frombuffer(chip.drain(1024)[-48:], ">i2").reshape(-1, 3)  # 1024 is no multiple of 6: aligned at the end
    assert newest.tolist() == [[0, 0, 6550]] * 8


@given(slip_deg=st.floats(-0.8, 0.8), after_ms=st.integers(0, 20), view_first=st.booleans())
@examples(7)
def test_short_knock_is_measured(slip_deg: float, after_ms: int, view_first: bool) -> None:
    with Chip() as chip:
        chip.wake(divider=1, fifo=0x10)
        chip.wait((20 + after_ms) * 1e-3)
        chip.drain()
        if view_first:
            chip.get(INT_STATUS)
        chip.world.slip(slip_deg)
        chip.wait(0.2)
        rates = np.frombuffer(chip.drain(), ">i2") / 131
        assert rates.sum() / 1000 == pytest.approx(slip_deg, abs=0.01)


@pytest.mark.parametrize("dlpf", [2, 3, 4, 5, 6])
def test_noise_has_the_density_and_the_bandwidth_of_the_filter(dlpf: int) -> None:
    density = 0.05  # ten times the part's: far above the quantisation
    noise = NoiseModel.none().with_values(gyro_noise_dps_rthz=density)
    with Chip(noise, seed=dlpf) as chip:
        chip.wake(divider=1, dlpf=dlpf, fifo=0x70)
        rates = []
        for _ in range(100):
            chip.wait(0.1)
            rates.append(np.frombuffer(chip.drain(chip.count() // 6 * 6), ">i2").reshape(-1, 3) / 131)
            assert len(rates[-1]) < 170
    rate = np.concatenate(rates)[200:]
    # A second-order Butterworth passes the noise of 1.11 times its corner; the spectrum's slow part is the density.
    expected = density * np.sqrt(1.11 * BANDWIDTH_HZ[dlpf])
    assert rate.std() == pytest.approx(expected, rel=0.1)
    second = rate[: len(rate) // 500 * 500].reshape(-1, 500, 3).sum(axis=1) / 1000  # half-second integrals
    assert second.std() == pytest.approx(density / np.sqrt(2) * np.sqrt(0.5), rel=0.35)


def test_parts_differ_and_their_bias_walks_as_the_noise_model_says() -> None:
    noise = NoiseModel(gyro_noise_dps_rthz=0.0, gyro_bias_walk_dps_rts=0.5)
    parts = [InertialModel(World(noise=noise, seed=seed), "imu") for seed in range(300)]
    begun_dps = np.array([part.gyro_bias_dps for part in parts])
    assert np.std(begun_dps) == pytest.approx(noise.gyro_bias_dps, rel=0.1)
    assert np.std([part.gyro_gain - 1 for part in parts]) == pytest.approx(noise.gyro_scale_error, rel=0.1)
    assert np.std([part.accel_bias_g for part in parts]) == pytest.approx(noise.accel_bias_g, rel=0.1)
    ups = np.array([part.up for part in parts])
    assert np.linalg.norm(ups, axis=1) == pytest.approx(1)
    assert np.std(np.degrees(np.arcsin(ups[:, :2]))) == pytest.approx(noise.imu_tilt_deg, rel=0.1)
    for part in parts:
        part.sample(np.arange(1, 41) * 100_000_000, 10.0, 4.9)  # 4 s
    walked_dps = np.array([part.gyro_bias_dps for part in parts]) - begun_dps
    assert np.std(walked_dps) == pytest.approx(noise.gyro_bias_walk_dps_rts * 2, rel=0.1)


@given(views_ms=st.lists(st.integers(1, 120), min_size=1, max_size=12), seed=st.integers(0, 2**32))
@examples(7)
def test_samples_do_not_depend_on_the_reading_rate(views_ms: list[int], seed: int) -> None:
    """The same seed gives the same bytes, for any sizes of the portions."""

    def fetch(views: list[int]) -> bytes:
        # Reads the device directly, so that no time passes during the transfers.
        world = World(seed=seed)
        sensor = SimMpu6050(world)

        def send(*data: int) -> None:
            sensor.start(reading=False)
            sensor.write(bytes(data))

        for message in ((PWR, 0x01), (DIV, 9, 3), (FIFO_EN, 0x78), (USER_CTRL, 0x40)):
            send(*message)
        world.drive(to_velocity(0.0, 0.0, 0.0, 60.0, 100.0))
        got = b""
        for view in views:
            world.clock.sleep(view * 1e-3)
            send(COUNT)
            count = int.from_bytes(sensor.read(2), "big")
            got += sensor.read(count)
        return got

    whole = fetch(views_ms)
    total_ms = sum(views_ms)
    at_once = fetch([total_ms])
    assert len(whole) == total_ms // 10 * 12
    assert whole[-len(at_once) :] == at_once if at_once else not whole
