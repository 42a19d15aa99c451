"""Mass properties of one body of a robot's model file: URDF and MJCF."""

from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from polhode._extras import imported


def read_urdf(path: str | PathLike[str], link: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,) and tensor (3, 3) about it, in the axes of a link."""
    name = Path(path).name
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError) as error:  # the second: an unknown encoding
        raise ValueError(f"{name} is not XML ({error}): expected a URDF file.") from error
    if root.tag != "robot":
        hint = "; MJCF files are read by from_mjcf" if root.tag == "mujoco" else ""
        raise ValueError(
            f"the root element of {name} is <{root.tag}>, a URDF file has <robot>{hint}."
        )
    # only links of the robot itself: extensions such as <gazebo> contain others
    names = [element.get("name") for element in root.findall("link")]
    if names.count(link) != 1:
        how_many = "no link" if link not in names else f"{names.count(link)} links"
        raise ValueError(f"{name} has {how_many} {link!r}, it has: {_listed(names)}.")
    inertial = root.findall("link")[names.index(link)].find("inertial")
    if inertial is None:
        raise ValueError(f"the link {link!r} of {name} has no <inertial> element.")
    where = f"the <inertial> of {link!r} in {name}"
    mass = _number(inertial.find("mass"), "value", where)
    entries = {
        key: _number(inertial.find("inertia"), key, where)
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    }
    origin = inertial.find("origin")
    centre, angles = (_three(origin, key, where) for key in ("xyz", "rpy"))
    link_inertia = np.array(
        [
            [entries["ixx"], entries["ixy"], entries["ixz"]],
            [entries["ixy"], entries["iyy"], entries["iyz"]],
            [entries["ixz"], entries["iyz"], entries["izz"]],
        ]
    )
    rotation_matrix = Rotation.from_euler("xyz", angles).as_matrix()  # about fixed axes, roll first
    return mass, centre, rotation_matrix @ link_inertia @ rotation_matrix.T


def read_mjcf(path: str | PathLike[str], body: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,) and tensor (3, 3) about it of a body in an MJCF file, as compiled
    by MuJoCo (which computes a missing inertia from the geoms)."""
    mujoco = imported("from_mjcf", "mujoco", extra="robots")
    if not Path(path).is_file():
        raise FileNotFoundError(f"no such file: {path}")
    name = Path(path).name
    if _root_tag(path) == "robot":  # MuJoCo reads URDF too, but merges links with fixed joints
        raise ValueError(f"{name} is a URDF file, which is read by from_urdf.")
    try:
        model: Any = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"MuJoCo does not read {name}: {error}") from error
    names = [model.body(i).name for i in range(model.nbody)]
    if not body or body not in names:
        listed = _listed(name for name in names if name)
        unnamed = names.count("")
        also = f", and {unnamed} without a name: give it one" if unnamed else ""
        raise ValueError(f"{name} has no body {body!r}, it has: {listed}{also}.")
    model_body = model.body(body)
    rotation_matrix = Rotation.from_quat(model_body.iquat, scalar_first=True).as_matrix()
    tensor = rotation_matrix @ np.diag(model_body.inertia) @ rotation_matrix.T
    return float(model_body.mass[0]), np.array(model_body.ipos), tensor


def _root_tag(path: str | PathLike[str]) -> str | None:
    try:
        with open(path, "rb") as file:
            return next(ElementTree.iterparse(file, events=("start",)))[1].tag
    except (ElementTree.ParseError, LookupError, StopIteration):  # MuJoCo names the mistake
        return None


def _listed(names: Any) -> str:
    return ", ".join(str(name) for name in names) or "none"


def _number(element: Any, key: str, where: str) -> float:
    text = None if element is None else element.get(key)
    try:
        return float(text)
    except (TypeError, ValueError):
        description = "nothing" if text is None else repr(text)
        raise ValueError(f"{where} needs a number {key}, got {description}{_hint(text)}.") from None


def _three(element: Any, key: str, where: str) -> np.ndarray:
    text = "0 0 0" if element is None else element.get(key, "0 0 0")
    try:
        first, second, third = (float(word) for word in text.split())
    except ValueError:
        raise ValueError(f"{where} needs three numbers {key}, got {text!r}{_hint(text)}.") from None
    return np.array([first, second, third])


def _hint(text: str | None) -> str:
    """A hint for an error message about an unexpanded xacro expression."""
    return " (expand the file by xacro first)" if text is not None and "${" in text else ""
