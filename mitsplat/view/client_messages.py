"""Validation of browser messages: expected kinds with bounded values, at the rate at which they are handled.

viser accepts every message of its protocol, including uploads, non-finite values, and control attributes by name. A
connection drops all messages except a few kinds with bounded, finite values, before viser receives them.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import msgspec
import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from websockets.asyncio.server import ServerConnection

MAX_MESSAGE_BYTES = 2**16
"""Maximum message size [bytes]; a connection that sends a larger message is closed."""


def _not_zero(vector: list[float]) -> list[float]:
    if np.linalg.norm(vector) < 1e-3:
        raise ValueError("must not be zero")
    return vector


def _unit(quaternion: list[float]) -> list[float]:
    if abs(np.linalg.norm(quaternion) - 1.0) > 0.01:
        raise ValueError("must be of length 1")
    return quaternion


_Name = Annotated[str, Field(max_length=200)]
_Text = Annotated[str, Field(max_length=10_000)]
_Number = Annotated[float, Field(ge=-1e6, le=1e6)]
_Vector = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Direction = Annotated[_Vector, AfterValidator(_not_zero)]
_Rotation = Annotated[list[_Number], Field(min_length=4, max_length=4), AfterValidator(_unit)]
_Pixel = Annotated[list[_Number], Field(min_length=2, max_length=2)]


class _Message(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class _CameraPose(_Message):
    type: Literal["ViewerCameraMessage"]
    wxyz: _Rotation
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Vector
    up_direction: _Direction

    @model_validator(mode="after")
    def _check_sight(self) -> Self:
        _not_zero([a - b for a, b in zip(self.look_at, self.position, strict=True)])
        return self


class _Value(_Message):
    value: bool | _Number | _Text | Annotated[list[_Number], Field(max_length=8)]


class _Control(_Message):
    type: Literal["GuiUpdateMessage"]
    uuid: _Name
    updates: _Value


class _NodeClick(_Message):
    type: Literal["SceneNodeClickMessage"]
    name: _Name
    instance_index: int | None
    ray_origin: _Vector
    ray_direction: _Direction
    screen_pos: _Pixel
    modifier: _Name | None
    owner: _Name = ""


class _SceneClick(_Message):
    type: Literal["ScenePointerMessage"]
    event_type: Literal["click"]
    ray_origin: _Vector
    ray_direction: _Direction
    screen_pos: Annotated[list[_Pixel], Field(max_length=2)]
    modifier: _Name | None


class _HandleMove(_Message):
    type: Literal["TransformControlsUpdateMessage"]
    name: _Name
    wxyz: _Rotation
    position: _Vector
    owner: _Name = ""


class _HandleDrag(_Message):
    type: Literal["TransformControlsDragStartMessage", "TransformControlsDragEndMessage"]
    name: _Name
    owner: _Name = ""


_EXPECTED: TypeAdapter[Any] = TypeAdapter(
    Annotated[
        _CameraPose | _Control | _NodeClick | _SceneClick | _HandleMove | _HandleDrag, Field(discriminator="type")
    ]
)


def is_expected(message: str | bytes) -> bool:
    """Return True if the message is one that the page's own script sends, with values in bounds."""
    if isinstance(message, str):
        return False
    try:
        _EXPECTED.validate_python(msgspec.msgpack.decode(message))
    except (msgspec.MsgspecError, ValidationError, RecursionError):
        return False
    return True


@dataclass
class MessageThreads:
    """Threads that handle messages.

    Attributes:
        threads: Executor of viser; None before the server starts.
    """

    threads: Executor | None = None

    async def wait_for_queue(self) -> None:
        """Wait until all queued jobs have started, so that a browser cannot queue an unlimited number."""
        if self.threads is not None:
            try:
                await asyncio.get_running_loop().run_in_executor(self.threads, int)
            except RuntimeError:  # the server is stopping
                self.threads = None


class Connection(ServerConnection):  # type: ignore[misc]  # of the extra `view`, which mypy does not read
    """Connection of a browser that receives only expected messages."""

    def __init__(self, *args: Any, pool: MessageThreads, **options: Any) -> None:
        super().__init__(*args, **options)
        self._pool = pool

    async def recv(self, decode: bool | None = None) -> Any:
        """Receive the next expected message; others are dropped.

        Raises:
            ConnectionClosed: If the connection is closed.
        """
        while True:
            await self._pool.wait_for_queue()
            message = await super().recv(decode)
            if is_expected(message):
                return message
