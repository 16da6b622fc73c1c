"""Note of ``glstar export`` on images of few bits in 16, which image viewers show almost black."""

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from glstar.export.task import FrameTask

__all__ = ["bit_note"]

# Depths at which full scale is at most a quarter of a 16-bit file's white.
_MAX_BITS: Final = 14


def bit_note(task: "FrameTask") -> str:
    """Return a note on how to see the images of an export.

    Parameters
    ----------
    task : FrameTask

    Returns
    -------
    str
        Empty if the images fill their files, or if astronomical viewers, which stretch them, read the files (FITS).
    """
    from glstar.export.processing import CameraProcessing  # noqa: PLC0415 - OpenCV, only when needed

    if task.image_format not in {"png16", "tiff"} or not len(task.frames.numbers):
        return ""
    sensor = task.frames.shot(int(task.frames.numbers[0])).simulator.sensor
    processing, largest_dn = CameraProcessing.of(sensor), task.frames.saturation_dn
    bits = largest_dn.bit_length()
    if processing.is_active or processing.align == "high" or bits > _MAX_BITS:
        return ""
    return (
        f"pixels hold {bits} bits, 0 to {largest_dn}, in files of 16: image viewers show them almost black. [output]"
        ' align = "high" shifts them to the highest bits; [output] process = "isp" develops them'
    )
