"""Settings of a MAVLink camera that a ground station changes, and the definition file that describes them.

The settings are the extended parameters of MAVLink, https://mavlink.io/en/services/parameter_ext.html, whose values are
bytes and not text, and the file of https://mavlink.io/en/services/camera_def.html, XML at the URI of
CAMERA_INFORMATION.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring
from zlib import crc32

from glstar.link.packets import dialect

# Bytes of a value, and of a name, in a packet.
_VALUE_BYTES, _NAME_BYTES = 128, 16
# A 32-bit float has this many digits: 0.1 s stays 0.1 s.
_DIGITS = 7


class CameraParameter(NamedTuple):
    """A setting of the camera."""

    name: str  # 16 characters at most; those that QGroundControl knows get their own controls
    key: str  # Of the config, such as exposure.duration_s; empty if it has none
    value: float
    low: float
    high: float
    unit: str
    description: str
    is_whole: bool = False

    @property
    def packed(self) -> bytes:
        """The value as the bytes of a packet."""
        number = struct.pack("<I", round(self.value)) if self.is_whole else struct.pack("<f", self.value)
        return number.ljust(_VALUE_BYTES, b"\0")

    def unpacked(self, content: bytes) -> float | None:
        """Return a value from the bytes of a packet; None if it is outside of the limits."""
        (number,) = struct.unpack_from("<I" if self.is_whole else "<f", content.ljust(4, b"\0"))
        value = float(f"{number:.{_DIGITS}g}")
        return value if self.low <= value <= self.high else None


# MAVSDK sets it to the mode of CAMERA_SETTINGS; this camera takes pictures only.
CAM_MODE = CameraParameter("CAM_MODE", "", 0, 0, 0, "", "Mode", is_whole=True)

# Takes settings by key, and returns span and interval of the exposures, s; raises ConfigError if they cannot be.
Changed = Callable[[Mapping[str, float]], tuple[float, float]]


class CameraParameters:
    """The settings of a camera by the messages PARAM_EXT; `values` has them by the key of the config."""

    def __init__(self, parameters: Sequence[CameraParameter]) -> None:
        m = self._mavlink = dialect()
        modes = (CAM_MODE,) if parameters else ()
        self._parameters = {parameter.name: parameter for parameter in (*modes, *parameters)}
        self.numbers = {
            m.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_LIST,
            m.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_READ,
            m.MAVLINK_MSG_ID_PARAM_EXT_SET,
        }

    @property
    def values(self) -> dict[str, float]:
        """The values by the key of the config; a copy."""
        keyed = [one for one in self._parameters.values() if one.key]
        return {one.key: int(one.value) if one.is_whole else one.value for one in keyed}

    def replies(self, message: Any, change: Callable[[Mapping[str, float]], bool]) -> list[Any]:
        """Return what is sent in return for a message of `numbers`.

        `change` takes the values by key, and returns whether they can be.
        """
        m = self._mavlink
        match message.get_msgId():
            case m.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_LIST:
                return [self._value(parameter) for parameter in self._parameters.values()]
            case m.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_READ:
                names = list(self._parameters)
                index = message.param_index
                name = message.param_id if index < 0 else names[index] if index < len(names) else ""
                return [self._value(self._parameters[name])] if name in self._parameters else []
            case _:
                return [self._set(message, change)]

    def _set(self, message: Any, change: Callable[[Mapping[str, float]], bool]) -> Any:
        """Change a value and return the acknowledgement, with the value as it is then."""
        m, old = self._mavlink, self._parameters.get(message.param_id)
        # pymavlink ends its own text at the first byte that is zero.
        content = message._param_value_raw  # noqa: SLF001 - the only place that has all of its bytes
        if old is None:
            name = message.param_id.encode()[:_NAME_BYTES]
            return m.MAVLink_param_ext_ack_message(name, content, message.param_type, m.PARAM_ACK_VALUE_UNSUPPORTED)
        value = old.unpacked(content) if message.param_type == self._type(old) else None
        new = old if value is None else old._replace(value=value)
        accepted = value is not None and (not new.key or change(self.values | {new.key: new.value}))
        if accepted:
            self._parameters[old.name] = new
        result = m.PARAM_ACK_ACCEPTED if accepted else m.PARAM_ACK_VALUE_UNSUPPORTED
        kept = self._parameters[old.name]
        return m.MAVLink_param_ext_ack_message(kept.name.encode(), kept.packed, self._type(kept), result)

    def _value(self, parameter: CameraParameter) -> Any:
        names = list(self._parameters)
        return self._mavlink.MAVLink_param_ext_value_message(
            parameter.name.encode(), parameter.packed, self._type(parameter), len(names), names.index(parameter.name)
        )

    def _type(self, parameter: CameraParameter) -> int:
        m = self._mavlink
        return int(m.MAV_PARAM_EXT_TYPE_UINT32 if parameter.is_whole else m.MAV_PARAM_EXT_TYPE_REAL32)


def camera_definition(model: str, parameters: Sequence[CameraParameter]) -> tuple[int, bytes]:
    """Return the version and the content of the definition file of a camera.

    Stations keep a file by vendor, model and version, so that another content has another version.
    """
    root = Element("mavlinkcamera")
    definition = SubElement(root, "definition")
    SubElement(definition, "model").text = model
    SubElement(definition, "vendor").text = "glstar"
    listed = SubElement(root, "parameters")
    mode = {"name": CAM_MODE.name, "type": "uint32", "default": "0", "control": "0"}
    entry = SubElement(listed, "parameter", mode)
    SubElement(entry, "description").text = CAM_MODE.description
    SubElement(SubElement(entry, "options"), "option", {"name": "Photo", "value": "0"})
    for one in parameters:
        limits = {"default": one.value, "min": one.low, "max": one.high, "step": 1 if one.is_whole else 0.001}
        numbers = {name: f"{value:g}" for name, value in limits.items()}
        kind = "uint32" if one.is_whole else "float"
        entry = SubElement(listed, "parameter", {"name": one.name, "type": kind, **numbers})
        if one.unit:
            entry.set("unit", one.unit)
        if not one.is_whole:
            entry.set("decimalPlaces", "3")
        SubElement(entry, "description").text = one.description
    indent(root)
    version = crc32(tostring(root)) % 0xFFFF + 1
    definition.set("version", str(version))
    return version, tostring(root, encoding="utf-8", xml_declaration=True)
