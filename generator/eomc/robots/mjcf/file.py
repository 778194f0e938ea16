"""Syntax of MJCF files: elements, attributes, settings, default classes, actuator shortcuts.

Sources are the XML reference of MuJoCo's documentation and, where it is ambiguous, the behaviour of
MuJoCo 3 and 4. No other file is opened, except included ones if `load` is called with `include`;
entities and document types are refused.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from eomc.base.errors import SceneError
from eomc.robots import xml
from eomc.robots.xml import (
    BOOLEAN,
    AttributeReader,
    Attributes,
    ElementSchema,
    ImportReport,
    Tag,
    parse_format,
)

# --- elements and attributes ----------------------------------------------------------------------

ORIENTATION = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}

_GROUPS = {
    "pose": "pos quat axisangle euler xyaxes zaxis",
    "softness": "solreflimit solimplimit solreffriction solimpfriction margin",
    "joint": """type group pos axis springdamper limited actuatorfrclimited stiffness range
        actuatorfrcrange actuatorgravcomp ref springref springyield armature damping frictionloss
        user""",
    "geom": """type contype conaffinity condim group priority size material friction mass density
        shellinertia solmix solref solimp margin gap surfacevel adhesion fromto hfield mesh
        fitscale rgba castshadow fluidshape fluidcoef user""",
    "site": "type group material size fromto mesh rgba user",
    "tendon": """group user limited actuatorfrclimited range actuatorfrcrange frictionloss
        springlength springyield stiffness damping armature""",
    "seen": "width material rgba",
    "soft": "active solref solimp",
    # of every actuator, more than some of them have: the transmission, ranges, delays
    "drive": """name class group user nsample interp delay ctrllimited ctrlrange forcelimited
        forcerange lengthrange gear cranklength cranksite slidersite joint jointinparent tendon
        site refsite armature damping""",
    "active": "actlimited actrange",
    "general": """actlimited actrange actdim actearly dyntype dynprm""",
}

_ACTUATORS = """
general: @drive @general body gaintype biastype gainprm biasprm inheritrange input ffrange velrange
motor: @drive
position: @drive kp kv dampratio timeconst inheritrange
velocity: @drive kv
intvelocity: @drive @active kp kv dampratio inheritrange
orientation: @drive kp kv dampratio input
pid: @drive kp ki kv dampratio imax inheritrange input ffrange posrange velrange slewmax
damper: @drive kv
cylinder: @drive timeconst area diameter bias
muscle: @drive timeconst tausmooth range force scale lmin lmax vmax fpmax fvmax
adhesion: @drive body gain
dcmotor: @drive cogging controller inductance input lugre motorconst nominal resistance saturation thermal
plugin: @drive @general plugin instance
 config: *
"""  # noqa: E501
ACTUATORS = frozenset(x.split(":")[0] for x in _ACTUATORS.strip().splitlines() if x[0] != " ")

# Sections and elements with * and + say nothing about the motion, or are reported as a whole.
_OUTLINE = f"""
mujoco: model
 compiler: alignfree angle assetdir autolimits balanceinertia boundinertia boundmass conflict convexhull coordinate discardvisual eulerseq exactmeshinertia fitaabb fusestatic inertiafromgeom inertiagrouprange meshdir passthrough savecanonical savecompiled saveinertial settotalmass strippath texturedir usethread
  lengthrange: *
 option: actuatorgroupdisable apirate ccd_iterations ccd_tolerance collision cone density gravity impratio integrator iterations jacobian ls_iterations ls_tolerance magnetic mpr_iterations mpr_tolerance noslip_iterations noslip_tolerance o_friction o_margin o_solimp o_solref sdf_initpoints sdf_iterations sleep_tolerance solver timestep tolerance viscosity wind
  flag: actuation autoreset clampctrl constraint contact damper diagexact energy equality eulerdamp filterparent frictionloss fwdinv gravity invdiscrete ipc island limit midphase multiccd nativeccd override passive refsafe sensor sensornoise sleep speculative spring warmstart
 size: *
 statistic: *
 visual: +
 extension: +
 asset: +
 deformable: +
 contact: +
 sensor: +
 custom: +
 default: class
  mesh: *
  texture: *
  material: *
  camera: *
  light: *
  pair: *
  joint: @joint @softness
  geom: @pose @geom
  site: @pose @site
  equality: @soft
  tendon: @tendon @softness @seen
  {_ACTUATORS.strip().replace(chr(10), chr(10) + "  ")}
 worldbody:
  body: name @pose childclass fuse gravcomp mocap simple sleep user
   inertial: @pose mass diaginertia fullinertia
   joint: name class @joint @softness
   freejoint: name align group
   geom: name class @pose @geom
    plugin: *
   site: name class @pose @site
   frame: name childclass @pose
   replicate: *
   composite: *
   flexcomp: *
   attach: *
   plugin: *
   skin: *
   camera: *
   light: *
 tendon:
  spatial: name class @tendon @softness @seen
   site: site
   geom: geom sidesite
   pulley: divisor
  fixed: name class @tendon @softness
   joint: joint coef
 equality:
  connect: name class @soft body1 body2 anchor site1 site2
  weld: name class @soft body1 body2 anchor relpose site1 site2 torquescale
  joint: name class @soft joint1 joint2 polycoef
  tendon: name class @soft tendon1 tendon2 polycoef
  flex: *
  flexvert: *
  flexstrain: *
  distance: *
 actuator:
  {_ACTUATORS.strip().replace(chr(10), chr(10) + "  ")}
 keyframe:
  key: name time qpos qvel act ctrl mpos mquat plastic
"""  # noqa: E501


def _nested(root: ElementSchema) -> ElementSchema:
    """Return the schema, with bodies, frames and default classes nested in one another."""
    default, world = root.children["default"], root.children["worldbody"]
    body = world.children["body"]
    default.children["default"] = default
    body.children["body"] = body
    body.children["frame"].children.update(body.children)
    world.children.update(body.children)
    return root


SCHEMA = _nested(parse_format(_OUTLINE, _GROUPS))
OPTIONS = SCHEMA.children["option"].attributes
FLAGS = SCHEMA.children["option"].children["flag"].attributes


# --- attributes that are not read ---------------------------------------------------------

# arrays of which an element may set the first entries and inherit the others from its class
PARTIAL = {"size", "gear", "stiffness", "damping", "gainprm", "biasprm", "dynprm"}

# attributes that are not read but change the motion in MuJoCo, unless their value is neutral
_FRICTION_SOFTNESS = (
    "the softness of friction (solreffriction, solimpfriction), which is exact here"
)
UNREAD = {
    "joint": {
        "springyield": "yield of the springs of joints",
        "actuatorgravcomp": "compensated weights as forces of actuators (actuatorgravcomp)",
        "solreffriction": _FRICTION_SOFTNESS,
        "solimpfriction": _FRICTION_SOFTNESS,
    },
    "tendon": {
        "springyield": "yield of the springs of tendons",
        "frictionloss": "friction of tendons",
    },
    "actuator": {"delay": "delays of actuators"},
}
NEUTRAL = {"false", "auto"}  # and zero

ONE_FILE = "let MuJoCo write the model as one file (MjSpec.to_xml)"  # a remedy

Classes = dict[str, dict[str, Attributes]]


# flags that change the motion, and the effects that they disable
EFFECTS = {
    "gravity": ("gravity",),
    "spring": ("spring",),
    "damper": ("damper",),
    "passive": ("spring", "damper"),  # of MuJoCo before 3.3.3
    "actuation": ("actuation",),
    "clampctrl": ("clampctrl",),
    "equality": ("equality",),
    "limit": ("limit",),
    "frictionloss": ("frictionloss",),
    "constraint": ("equality", "limit", "frictionloss"),
}


@dataclass(frozen=True)
class Settings:
    """Settings of <compiler> and <option> in an MJCF file that affect masses and motion.

    The names are those of the attributes in MJCF, except for these.

    Attributes
    ----------
    degrees : bool
        Whether angles are in degrees.
    inertia : str
        Whether masses follow from geoms: "true", "false", or "auto" for bodies without <inertial>.
    groups : (float, float)
        Range of the groups of geoms that have mass.
    totalmass : float
        Total mass to which all masses are scaled (kg), if positive.
    balance : bool
        Whether inertia tensors that violate the triangle inequality are replaced.
    disabled : frozenset of str
        Effects that flags of the file disable, values of `EFFECTS`.
    off_groups
        Groups of actuators that are disabled.
    """

    degrees: bool = True
    eulerseq: str = "xyz"
    autolimits: bool = True
    inertia: str = "auto"  # from geoms: "true", "false", or "auto" where there is no <inertial>
    groups: tuple[float, float] = (0, 5)
    boundmass: float = 0.0
    boundinertia: float = 0.0
    totalmass: float = -1.0
    balance: bool = False
    alignfree: bool = False
    disabled: frozenset[str] = frozenset()  # of the values of EFFECTS
    off_groups: Collection[float] = ()  # of actuators
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)

    def angle(self, value: float) -> float:
        """Return an angle in rad; `value` is in the file's unit (degrees or radians)."""
        return math.radians(value) if self.degrees else value


# --- the file -------------------------------------------------------------------------------------


def load(path: Path, include: bool, report: ImportReport) -> Tag:
    """Return the root element of a file, with each <include> replaced by the included elements.

    `include` says whether included files may be opened. Raises SceneError at once if a file cannot
    be included, since elements that refer to its contents would be reported as faults too.
    """
    root = xml.root(path)
    folder = path.resolve().parent
    opened = {path.resolve()}
    waiting = [root]
    while waiting:
        tag = waiting.pop()
        children: list[Tag] = []
        queue = tag.children[::-1]
        while queue:
            child = queue.pop()
            if child.kind == "include":
                queue += _included(child, folder, include, opened, report)[::-1]
            else:
                children.append(child)
        tag.children[:] = children
        waiting += children
    if report.faults:
        raise SceneError(report.faults)
    return root


def _included(
    tag: Tag, folder: Path, include: bool, opened: set[Path], report: ImportReport
) -> list[Tag]:
    """Return the elements of the file that <include> refers to; it must lie in `folder`."""
    a = AttributeReader(tag.attributes, tag, report)
    name = a.get("file")
    if not include:
        a.fault(
            f'the file "{name}" is not opened: allow it with --include, '
            "or put what it holds in the place of <include>"
        )
        return []
    target = (folder / name).resolve()
    if not target.is_relative_to(folder):
        a.fault(
            f'"{name}" lies outside the folder of the model; move it into the folder, or {ONE_FILE}'
        )
    elif target in opened:
        a.fault(f'"{name}" is included a second time; MJCF allows it once')
    elif not target.is_file():
        a.fault(f'there is no file "{name}" in the folder of the model')
    else:
        opened.add(target)
        return xml.root(target).children
    return []


def note_unread_attributes(a: AttributeReader, kind: str, name: str) -> None:
    """Note in the report those attributes of an element that are ignored but affect the motion.

    `UNREAD` lists such attributes for each `kind` of element. `name` is that of the element.
    """
    for key, what in UNREAD[kind].items():
        if any(word.strip("-+0.") for word in a.get(key).split() if word not in NEUTRAL):
            a.report.leave_out(what, name)


# --- settings and defaults ------------------------------------------------------------------------


def read_settings(root: Tag, report: ImportReport) -> Settings:
    """Return the settings in the elements <compiler> and <option> of a file.

    If a setting is repeated, the last value applies. Settings that are not modelled are noted in
    `report`.
    """
    s = Settings()
    disabled = dict.fromkeys(EFFECTS, False)  # by flag; flags accumulate over all <option> elements
    groups: set[float] = set()
    for tag in root.each("compiler"):
        s = _compiler(s, AttributeReader(tag.attributes, tag, report))
    for tag in root.each("option"):
        a = AttributeReader(tag.attributes, tag, report)
        s = replace(s, gravity=a.vector("gravity") or s.gravity)
        groups.update(a.numbers("actuatorgroupdisable", 31, 0) or ())
        for key in a.attributes:
            if key in {"density", "viscosity", "wind"}:
                if any(a.numbers(key, 3, 1) or ()):
                    report.leave_out("forces of the surrounding fluid", key)
            elif key not in {"gravity", "actuatorgroupdisable"} and key in OPTIONS:
                report.leave_out("options of MuJoCo's simulation", key)
        for flag in tag.each("flag"):
            f = AttributeReader(flag.attributes, flag, report)
            for key in f.attributes:
                if key in EFFECTS:
                    disabled[key] = f.choice(key, ("enable", "disable")) == "disable"
                elif key in FLAGS:
                    report.leave_out("flags of MuJoCo's simulation", f"{key}={f.get(key)}")
    those = [key for key, off in disabled.items() if off]
    for key in those:
        report.leave_out("switched off by <flag> of the file", key)
    s = replace(s, disabled=frozenset(e for key in those for e in EFFECTS[key]), off_groups=groups)
    return replace(s, gravity=(0.0, 0.0, 0.0)) if "gravity" in s.disabled else s


def _compiler(s: Settings, a: AttributeReader) -> Settings:
    if a.get("coordinate", "local") != "local":
        a.fault(
            'coordinate="global" is not read, nor by MuJoCo since 2.3.4; '
            "let an older MuJoCo save the model in local coordinates"
        )
    seq = a.get("eulerseq", s.eulerseq)
    if len(seq) != 3 or set(seq.lower()) - set("xyz"):
        a.fault(f'eulerseq="{seq}" must be three of x, y, z, X, Y, Z')
        seq = s.eulerseq
    groups = a.numbers("inertiagrouprange", 2)
    angle = a.choice("angle", ("degree", "radian"), "degree" if s.degrees else "radian")
    return replace(
        s,
        degrees=angle == "degree",
        eulerseq=seq,
        autolimits=a.is_true("autolimits", s.autolimits),
        inertia=a.choice("inertiafromgeom", ("auto", *BOOLEAN), s.inertia),
        groups=(groups[0], groups[1]) if groups else s.groups,
        boundmass=a.number("boundmass", s.boundmass),
        boundinertia=a.number("boundinertia", s.boundinertia),
        totalmass=a.number("settotalmass", s.totalmass),
        balance=a.is_true("balanceinertia", s.balance),
        alignfree=a.is_true("alignfree", s.alignfree),
    )


def read_default_classes(root: Tag, report: ImportReport) -> Classes:
    """Return the default classes of a file: attribute values that its elements can inherit.

    The result maps the name of each class and the kind of element to the attributes. Attributes
    that a class inherits from an outer class are included. All actuators of a class share one
    entry, "actuator". Faults are added to `report`.
    """
    classes: Classes = {"main": {}}
    for top in root.each("default"):
        name = top.get("class", "main")
        waiting = [(top, "main")]
        if name != "main":
            classes[name] = classes["main"]
        while waiting:
            tag, name = waiting.pop()
            own = classes[name]
            for child in tag.children:
                kind = "actuator" if child.kind in ACTUATORS else child.kind
                if kind != "default":
                    own[kind] = with_defaults(own.get(kind, {}), child)
            for child in tag.each("default"):
                a = AttributeReader(child.attributes, child, report)
                inner = a.get("class")
                if not inner:
                    a.fault('a <default> inside another needs a name: class="..."')
                elif inner in classes:
                    a.fault(f'there are two default classes "{inner}"; rename one')
                else:
                    classes[inner] = dict(own)
                    waiting.append((child, inner))
    return classes


def with_defaults(base: Attributes, tag: Tag) -> Attributes:
    """Return the attributes of the element `tag`, completed by those of its default class.

    `base` has the attributes of the class. An orientation replaces an inherited one of any kind,
    and `fromto` replaces an inherited pose. A shortcut such as <position> is converted to the
    attributes of <general>, and its name is stored under the key " law".
    """
    own = {k: v for k, v in tag.attributes.items() if k not in {"class", "childclass"}}
    over = dict(base)
    if own.keys() & ORIENTATION.keys() or "fromto" in own:
        over = {k: v for k, v in over.items() if k not in ORIENTATION}
    if "fromto" in own:
        over.pop("pos", None)
    if tag.kind in ACTUATORS and tag.kind != "general":
        over |= expand_shortcut(tag.kind, over, own) | {" law": tag.kind}
    for key, value in own.items():
        words = value.split()
        if key in PARTIAL and key in over:
            words += over[key].split()[len(words) :]
            value = " ".join(words)
        over[key] = value
    return over


# --- actuator shortcuts ---------------------------------------------------------------------------

# numeric attributes of shortcuts
MEASURES = ("kp", "kv", "dampratio", "timeconst", "area", "diameter")


def expand_shortcut(
    kind: str, inherited: Mapping[str, str], own: Mapping[str, str]
) -> dict[str, str]:
    """Return the attributes of <general> that an actuator shortcut such as <position> sets.

    Parameters
    ----------
    kind : str
        Name of the shortcut.
    inherited, own
        Attributes of its default class, and of the element. Missing numbers are inherited, except
        from a class with another shortcut or without a constant gain.

    Returns
    -------
    dict
        The attributes. A shortcut whose force is not affine in its input has `kind` as gaintype and
        biastype.
    """
    same = inherited.get(" law") == kind
    if not same and (" law" in inherited or inherited.get("gaintype", "fixed") != "fixed"):
        inherited = {}
    gain = (*inherited.get("gainprm", "1").split(), "0", "0", "0")
    bias = (*inherited.get("biasprm", "").split(), "0", "0", "0")
    affine = {"gaintype": "fixed", "biastype": "affine"}
    if kind == "motor":
        return {"gaintype": "fixed", "biastype": "none", "dyntype": "none", "gainprm": "1"}
    if kind in ("position", "intvelocity"):
        kp = own.get("kp", gain[0])
        kv = _minus(own["kv"]) if "kv" in own else own.get("dampratio", bias[2])
        attributes = affine | {"gainprm": kp, "biasprm": f"0 {_minus(kp)} {kv}"}
        attributes["dyntype"] = inherited.get("dyntype", "none") if same else "none"
        if "timeconst" in own:
            attributes["dyntype"] = "filterexact" if _value(own["timeconst"]) else "none"
        integrates = {"dyntype": "integrator", "actlimited": "true"}
        return attributes | (integrates if kind == "intvelocity" else {})
    if kind == "velocity":
        kv = own.get("kv", gain[0])
        return affine | {"dyntype": "none", "gainprm": kv, "biasprm": f"0 0 {_minus(kv)}"}
    if kind == "damper":
        types = {"gaintype": "affine", "biastype": "none", "dyntype": "none", "ctrllimited": "true"}
        rate = _minus(own["kv"]) if "kv" in own else gain[2]
        return types | {"gainprm": f"0 0 {rate}"}
    if kind == "cylinder":
        area = own.get("area", gain[0])
        if "diameter" in own:
            area = repr(math.pi / 4 * _value(own["diameter"]) ** 2)
        own_bias = own.get("bias", "").split()
        bias_text = " ".join([*own_bias, *bias[len(own_bias) :]][:3])
        return affine | {"dyntype": "filter", "gainprm": area, "biasprm": bias_text}
    return {"gaintype": kind, "biastype": kind}


def _value(text: str) -> float:
    """Return a number; 0 for a fault, which is reported where the attribute is read."""
    try:
        return xml.number(text)
    except ValueError:
        return 0.0


def _minus(text: str) -> str:
    return repr(-_value(text))
