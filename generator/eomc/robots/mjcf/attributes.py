"""The attributes that elements of MJCF have, those of older MuJoCo included."""

from __future__ import annotations

ORIENTATION = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
_PLACE = {"name", "class", "pos", "user", "group", *ORIENTATION}
_CONTACT = set("solreflimit solimplimit solreffriction solimpfriction margin".split())
_SOFT = {"name", "class", "active", "solref", "solimp"}
_FIXED = _CONTACT | set(
    """name class group user limited actuatorfrclimited range actuatorfrcrange frictionloss
    springlength springyield stiffness damping armature""".split()
)
_SPATIAL = _FIXED | {"width", "material", "rgba"}
# of all actuators, more than some of them have: the transmission, ranges, delays
_DRIVE = set(
    """name class group user nsample interp delay ctrllimited ctrlrange forcelimited forcerange
    lengthrange gear cranklength cranksite slidersite joint jointinparent tendon site refsite
    armature damping""".split()
)
_ACTIVE = {"actlimited", "actrange"}
_GENERAL = _ACTIVE | set("actdim actearly dyntype dynprm".split())
_OWN = {
    "general": _GENERAL
    | set("body gaintype biastype gainprm biasprm inheritrange input ffrange velrange".split()),
    "motor": set[str](),
    "position": {"kp", "kv", "dampratio", "timeconst", "inheritrange"},
    "velocity": {"kv"},
    "intvelocity": _ACTIVE | {"kp", "kv", "dampratio", "inheritrange"},
    "orientation": {"kp", "kv", "dampratio", "input"},
    "pid": set(
        "kp ki kv dampratio imax inheritrange input ffrange posrange velrange slewmax".split()
    ),
    "damper": {"kv"},
    "cylinder": {"timeconst", "area", "diameter", "bias"},
    "muscle": set("timeconst tausmooth range force scale lmin lmax vmax fpmax fvmax".split()),
    "adhesion": {"body", "gain"},
    "dcmotor": set(
        """cogging controller inductance input lugre motorconst nominal resistance saturation
        thermal""".split()
    ),
    "plugin": _GENERAL | {"plugin", "instance"},
}
ACTUATORS = frozenset(_OWN)

# by an element, or by the one around it and itself where what it has depends on that
_KNOWN = {
    "compiler": set(
        """alignfree angle assetdir autolimits balanceinertia boundinertia boundmass conflict
        convexhull coordinate discardvisual eulerseq exactmeshinertia fitaabb fusestatic
        inertiafromgeom inertiagrouprange meshdir passthrough savecanonical savecompiled
        saveinertial settotalmass strippath texturedir usethread""".split()
    ),
    "option": set(
        """actuatorgroupdisable apirate ccd_iterations ccd_tolerance collision cone density
        gravity impratio integrator iterations jacobian ls_iterations ls_tolerance magnetic
        mpr_iterations mpr_tolerance noslip_iterations noslip_tolerance o_friction o_margin
        o_solimp o_solref sdf_initpoints sdf_iterations sleep_tolerance solver timestep tolerance
        viscosity wind""".split()
    ),
    "flag": set(
        """actuation autoreset clampctrl constraint contact damper diagexact energy equality
        eulerdamp filterparent frictionloss fwdinv gravity invdiscrete ipc island limit midphase
        multiccd nativeccd override passive refsafe sensor sensornoise sleep speculative spring
        warmstart""".split()
    ),
    "default": {"class"},
    "default/tendon": _SPATIAL,
    "default/equality": _SOFT,
    "body": _PLACE | {"childclass", "mocap", "gravcomp", "sleep", "simple", "fuse"},
    "frame": _PLACE | {"childclass"},
    "inertial": _PLACE | {"mass", "diaginertia", "fullinertia"},
    "freejoint": {"name", "group", "align"},
    "joint": _CONTACT
    | set(
        """name class type group pos axis springdamper limited actuatorfrclimited stiffness range
        actuatorfrcrange actuatorgravcomp ref springref springyield armature damping frictionloss
        user""".split()
    ),
    "geom": _PLACE
    | set(
        """type contype conaffinity condim priority size material friction mass density
        shellinertia solmix solref solimp margin gap surfacevel adhesion fromto hfield mesh
        fitscale rgba castshadow fluidshape fluidcoef""".split()
    ),
    "site": _PLACE | set("type size fromto material mesh rgba".split()),
    "fixed": _FIXED,
    "fixed/joint": {"joint", "coef"},
    "spatial": _SPATIAL,
    "equality/connect": _SOFT | set("body1 body2 anchor site1 site2".split()),
    "equality/weld": _SOFT
    | set("body1 body2 anchor relpose site1 site2 torquescale".split()),
    "equality/joint": _SOFT | {"joint1", "joint2", "polycoef"},
    "equality/tendon": _SOFT | {"tendon1", "tendon2", "polycoef"},
    "key": set("name time qpos qvel act ctrl mpos mquat plastic".split()),
    **{kind: _DRIVE | own for kind, own in _OWN.items()},
}  # fmt: skip


def attributes(kind: str, around: str = "") -> set[str]:
    """Those of an element, `around` the kind of the one around it; none where it isn't known."""
    return _KNOWN.get(f"{around}/{kind}") or _KNOWN.get(kind, set())
