"""The elements and attributes of MJCF: MuJoCo's own schema, with what older MuJoCo had besides."""

from __future__ import annotations

from eomc.robots.xml import ElementSchema, parse_format

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
    """The schema in which bodies, frames and default classes stand in one another."""
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
