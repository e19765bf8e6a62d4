import numpy as np
from numpy.typing import ArrayLike, NDArray

def solve(
    force: NDArray[np.float64],
    state: NDArray[np.uint8],
    residual: NDArray[np.float32],
    normal: NDArray[np.float64],
    compliance: NDArray[np.float32],
    active: NDArray[np.int32],
    friction: float,
    max_sweeps: int,
    tolerance: float,
) -> int: ...
def displacement(
    out: NDArray[np.float32],
    force: NDArray[np.float64],
    compliance: NDArray[np.float32],
    active: NDArray[np.int32],
) -> None: ...
def render(
    image: NDArray[np.uint8],
    background: NDArray[np.float32],
    blobs: NDArray[np.float64],
    softness: float,
    noise: NDArray[np.float32] | None,
    seed: int,
    canvas: NDArray[np.float32],
) -> None: ...
def draw_input(
    input: NDArray[np.uint8],
    discs: NDArray[np.float64],
    ground: NDArray[np.float32],
    mask: NDArray[np.float32],
    view: tuple[float, ...],
) -> None: ...

_Foot = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
_Touch = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float, float, bool]

def foot_inside(foot: _Foot, point: ArrayLike, /) -> tuple[float, int]: ...
def foot_edge_share(foot: _Foot, point: ArrayLike, /) -> float: ...
def return_to_surface(
    load: ArrayLike,
    stiffness: ArrayLike,
    force: float,
    torque: float,
    floor: tuple[str, ArrayLike, float] | None = None,
    /,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
def point_contact_drag(
    anchor: ArrayLike,
    turn: float,
    T_before: ArrayLike,
    point_before: ArrayLike,
    normal_before: ArrayLike,
    depth_before: float,
    T: ArrayLike,
    point: ArrayLike,
    normal: ArrayLike,
    depth: float,
    limits: ArrayLike,
    /,
) -> tuple[NDArray[np.float64], float, bool]: ...
def point_contact_pose(
    T_fs: ArrayLike,
    turn: float,
    T: ArrayLike,
    point: ArrayLike,
    normal: ArrayLike,
    depth: float,
    anchor: ArrayLike | None,
    /,
) -> NDArray[np.float64]: ...
def skin_force(
    T_body_sensor: ArrayLike, T_fs: ArrayLike, press: float, stiffness: float, friction: float, /
) -> NDArray[np.float64]: ...

class PushedBody:
    def __init__(
        self,
        foot: _Foot,
        arm: float,
        T_world_body: ArrayLike,
        center_of_gravity: ArrayLike,
        weight: float,
        friction: float,
        center_of_friction: ArrayLike,
        edge_friction: float,
        edge_way: float,
        friction_tip: float,
        floor: tuple[str, ArrayLike, float] | None = None,
    ) -> None: ...
    def tip(
        self,
        T_tool_sensor: ArrayLike,
        T_body_sensor: ArrayLike,
        point: ArrayLike,
        normal: ArrayLike,
        force: ArrayLike,
        along: float,
        across: float,
        /,
    ) -> bytes: ...
    def step(self, *tools_and_tips: ArrayLike | bytes) -> list[_Touch] | None: ...
    def set_floor(self, friction: float, center_of_friction: ArrayLike, /) -> None: ...
    def lean(self, T_world_body: ArrayLike, tilted: float, edge: ArrayLike, /) -> None: ...
    @property
    def T_world_body(self) -> NDArray[np.float64]: ...
    @property
    def T_world_upright(self) -> NDArray[np.float64]: ...
    @property
    def pressure(self) -> tuple[float, float]: ...
    @property
    def turn(self) -> float: ...
    @property
    def inside(self) -> float: ...
    @property
    def load(self) -> float: ...
    @property
    def friction(self) -> float: ...
    @property
    def moved(self) -> float: ...
