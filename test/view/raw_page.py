"""What a page sends, without a page: messages of viser's protocol."""

import msgspec

#: What makes a client known: its view of the scene.
LOOKING = msgspec.msgpack.encode(
    {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 0.0, 0.0), "fov": 1.0,
        "near": 0.01, "far": 10.0, "image_height": 10, "image_width": 10, "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, 0.0, 1.0),
    }
)  # fmt: skip


def setting(element: str, value: object) -> bytes:
    """An element's new value, as if a person had given it."""
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": element, "updates": {"value": value}})
