"""XMP packets: what drone makers write of gimbal, receiver and lens beside EXIF (ISO 16684-1, XML in the file)."""

from __future__ import annotations

from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_PIX4D = "http://pix4d.com/camera/1.0"
_BYTES_AT_MOST = 1_000_000
_LEVELS_AT_MOST = 4


def read_xmp(packet: bytes | str) -> dict[str, str]:
    """The properties of an XMP packet.

    Names come without their namespace, for each maker has its own and names the same things alike ("GimbalYawDegree");
    only those of Pix4D's namespace, whose names are common words, are marked: "Camera:Yaw". The parts of a structure
    come as "CameraOrientationNED/Yaw", the items of a list with commas between.

    Raises:
        ValueError: the packet is no XML, has entities, or is too large to be trusted.
    """
    data = packet.encode() if isinstance(packet, str) else packet
    if len(data) > _BYTES_AT_MOST:
        raise ValueError(f"it has {len(data)} bytes")
    data = data.strip(b"\0 \t\r\n")
    if not data:
        return {}
    try:
        root = fromstring(data)
    except (ParseError, DefusedXmlException, UnicodeError, LookupError) as error:
        raise ValueError(str(error)) from error
    found: dict[str, str] = {}
    for description in root.iter(f"{_RDF}Description"):
        _collect(description, "", _LEVELS_AT_MOST, found)
    return found


def _collect(element: Element, prefix: str, levels: int, found: dict[str, str]) -> None:
    """Add an element's properties, which may be written as attributes or as children; the first of a name counts."""
    for tag, value in element.attrib.items():
        if not tag.startswith(_RDF):
            found.setdefault(prefix + _name(tag), value.strip())
    for child in element:
        if child.tag == f"{_RDF}Description" or child.tag.startswith(_RDF):
            continue
        name = prefix + _name(child.tag)
        items = [item.text or "" for item in child.iter(f"{_RDF}li")]
        text = ",".join(items) if items else (child.text or "")
        if text.strip():
            found.setdefault(name, text.strip())
        if levels > 0:
            for structure in (child, *child.findall(f"{_RDF}Description")):
                _collect(structure, f"{name}/", levels - 1, found)


def _name(tag: str) -> str:
    namespace, _, name = tag.rpartition("}")
    return f"Camera:{name}" if namespace.lstrip("{").rstrip("/") == _PIX4D else name
