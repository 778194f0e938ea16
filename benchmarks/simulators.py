"""Simulators of bodies on joints for benchmarks/peers.py: MuJoCo and Pinocchio.

Both of the Panda are made from one model, that which Pinocchio reads from the URDF, so that all
have the same bodies: all between two joints as one, the hand and the locked fingers with the last.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio
from runners import Array, Run, timed
from work import panda_model

# whatever is not motion of bodies on joints is switched off
OFF = """contact constraint limit equality frictionloss actuation sensor warmstart clampctrl refsafe
filterparent eulerdamp autoreset energy""".split()
MJCF = """<mujoco><compiler angle="radian" autolimits="false"/>
<option integrator="RK4" gravity="0 0 %s"><flag %s/></option><worldbody>%s</worldbody></mujoco>"""


def by_mujoco(gravity: float, bodies: str) -> Run:
    """mj_step in MuJoCo's own loop over the steps."""
    flags = " ".join(f'{name}="disable"' for name in OFF)
    model = mujoco.MjModel.from_xml_string(MJCF % (gravity, flags, bodies))
    data = mujoco.MjData(model)

    def run(x: Array, h: float, steps: int) -> Array:
        model.opt.timestep = h
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = x.reshape(2, -1)
        mujoco.mj_step(model, data, nstep=steps)
        return np.concatenate([data.qpos, data.qvel])

    return run


def mujoco_cartpole() -> Run:
    """scenes/cartpole.toml: a cart of 2 kg on a slide, a rod of 2 kg and 2 m on a hinge."""
    return by_mujoco(
        -9.8,
        '<body><joint type="slide" axis="1 0 0"/>'
        '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>'
        '<body><joint axis="0 -1 0"/>'
        f'<inertial pos="0 0 1" mass="2" diaginertia="{2 / 3!r} {2 / 3!r} {2 / 3!r}"/>'
        "</body></body>",
    )


def mujoco_panda() -> Run:
    model, bodies = panda_model(), ""

    def numbers(values: Any) -> str:
        return " ".join(repr(float(x)) for x in values)

    for i in range(1, model.njoints):
        at, body = model.jointPlacements[i], model.inertias[i]
        x, y, z, w = pinocchio.Quaternion(at.rotation).coeffs()
        J = body.inertia
        six = (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
        bodies += f'<body pos="{numbers(at.translation)}" quat="{numbers((w, x, y, z))}">'
        bodies += f'<joint axis="0 0 1" damping="{float(model.damping[i - 1])!r}"/>'
        bodies += f'<inertial pos="{numbers(body.lever)}" mass="{body.mass!r}" '
        bodies += f'fullinertia="{numbers(six)}"/>'
    return by_mujoco(model.gravity.linear[2], bodies + "</body>" * (model.njoints - 1))


def pinocchio_python() -> Run:
    """pin.aba from Python, a loop in NumPy around it."""
    model = panda_model()
    data, n = model.createData(), model.nv

    def run(x: Array, h: float, steps: int) -> Array:
        q, v = x[:n], x[n:]

        def aba(q: Array, v: Array) -> Array:
            return pinocchio.aba(model, data, q, v, -model.damping * v)

        for _ in range(steps):
            a1 = aba(q, v).copy()
            a2 = aba(q + h / 2 * v, v + h / 2 * a1).copy()
            a3 = aba(q + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2).copy()
            a4 = aba(q + h * v + h * h / 2 * a2, v + h * a3)
            q = q + h * v + h * h / 6 * (a1 + a2 + a3)
            v = v + h / 6 * (a1 + 2 * (a2 + a3) + a4)
        return np.concatenate([q, v])

    return run


# The library's own instance of aba is taken: it exists for Eigen::Ref, and compiling another takes
# minutes and runs no faster, -O3 and -march=native included.
PINOCCHIO = """
#include <pinocchio/multibody.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>
using namespace pinocchio;
typedef Eigen::VectorXd Vector;
typedef Eigen::Ref<const Vector> Ref;
typedef Eigen::Map<const Eigen::Vector3d> Three;
typedef Eigen::Map<const Eigen::Matrix3d> Nine;

extern "C" void *make(int n, const double *rotation, const double *translation, const double *mass,
    const double *lever, const double *inertia)
{
    Model *model = new Model;
    for (int i = 0; i < n; ++i) {
        const SE3 at(Nine(rotation + 9*i), Three(translation + 3*i));
        const JointIndex joint = model->addJoint(i, JointModelRZ(), at, "j" + std::to_string(i));
        const Inertia body(mass[i], Three(lever + 3*i), Nine(inertia + 9*i));
        model->appendBodyToJoint(joint, body, SE3::Identity());
    }
    return model;
}

extern "C" void run(void *made, const double *damping, double *x, double h, long steps, int world)
{
    const Model &model = *static_cast<Model *>(made);
    const int n = model.nv;
    const Convention how = world ? Convention::WORLD : Convention::LOCAL;
    Data data(model);
    Eigen::Map<Vector> q(x, n), v(x + n, n);
    const Eigen::Map<const Vector> b(damping, n);
    Vector at(n), moving(n), tau(n), a1(n), a2(n), a3(n);
    const auto aba_there = [&]() -> const Vector & {
        tau = -b.cwiseProduct(moving);
        return aba(model, data, Ref(at), Ref(moving), Ref(tau), how);
    };

    for (long k = 0; k < steps; ++k) {
        at = q, moving = v;
        a1 = aba_there();
        at = q + h/2*v, moving = v + h/2*a1;
        a2 = aba_there();
        at = q + h/2*v + h*h/4*a1, moving = v + h/2*a2;
        a3 = aba_there();
        at = q + h*v + h*h/2*a2, moving = v + h*a3;
        const Vector &a4 = aba_there();
        q += h*v + h*h/6*(a1 + a2 + a3);
        v += h/6*(a1 + 2*(a2 + a3) + a4);
    }
}
"""
# one function of bodies at n states, rows of x; what it is for the last joint, or the forces
FUNCTIONS = """
extern "C" void functions(void *made, int which, long n, const double *q, const double *v,
    const double *a, double *out)
{
    const Model &model = *static_cast<Model *>(made);
    const int nv = model.nv;
    const JointIndex last = model.njoints - 1;
    Data data(model);
    Vector at(nv), moving(nv), faster(nv);

    for (long k = 0; k < n; ++k, q += nv, v += nv, a += nv) {
        at = Eigen::Map<const Vector>(q, nv);
        if (which == 0) {
            moving = Eigen::Map<const Vector>(v, nv), faster = Eigen::Map<const Vector>(a, nv);
            Eigen::Map<Vector>(out + k*nv, nv) =
                rnea(model, data, Ref(at), Ref(moving), Ref(faster));
        } else if (which == 1) {
            forwardKinematics(model, data, Ref(at));
            Eigen::Map<Eigen::Vector3d>(out + 3*k) = data.oMi[last].translation();
        } else {
            computeJointJacobians(model, data, Ref(at));
            Eigen::Map<Vector>(out + k*nv, nv) = data.J.row(2);
        }
    }
}
"""
DEFINED = """-DNDEBUG -DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION -DBOOST_MPL_LIMIT_LIST_SIZE=30
-DBOOST_MPL_LIMIT_VECTOR_SIZE=30 -DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS
-DBOOST_FUSION_INVOKE_MAX_ARITY=12""".split()  # what its CMake files ask for


def pinocchio_loop(root: Path) -> Run:
    """The same loop in C++; in the quicker of aba's two conventions."""
    loaded, made = pinocchio_library(root)
    model = panda_model()
    damping = np.array(model.damping)

    def loop(world: int) -> Run:
        def run(x: Array, h: float, steps: int) -> Array:
            y = np.array(x, float)
            loaded.run(made, damping.ctypes.data, y.ctypes.data, h, steps, world)
            return y

        return run

    at = np.zeros(2 * model.nv)
    return min(
        map(loop, (0, 1)), key=lambda run: min(timed(run, at, 1e-3, 200)[0] for _ in "five!")
    )


def pinocchio_library(root: Path) -> tuple[ctypes.CDLL, int]:
    """Loops in C++ on the library of the wheel, and the Panda there.

    -march=native would lay Eigen's types out otherwise than the library did."""
    model = panda_model()
    assert {joint.shortname() for joint in list(model.joints)[1:]} == {"JointModelRZ"}
    assert model.parents.tolist()[1:] == list(range(model.njoints - 1))
    base = next(p for p in Path(pinocchio.__file__).parents if (p / "include").is_dir())
    folder = Path(tempfile.mkdtemp(dir=root))
    file, library = folder / "loop.cpp", folder / "loop.so"
    file.write_text(PINOCCHIO + FUNCTIONS, encoding="utf-8")
    paths = [f"-I{base}/include", f"-I{base}/include/eigen3", f"-L{base}/lib"]
    paths += [f"-Wl,-rpath,{base}/lib", "-lpinocchio_default"]
    flags = ["-std=c++17", "-O2", *DEFINED, "-fPIC", "-shared"]
    subprocess.run(["c++", *flags, str(file), "-o", str(library), *paths], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.make.restype = ctypes.c_void_p
    loaded.make.argtypes = [ctypes.c_int, *[ctypes.c_void_p] * 5]
    loaded.run.argtypes = [*[ctypes.c_void_p] * 3, ctypes.c_double, ctypes.c_long, ctypes.c_int]

    def each(get: Callable[[int], Any]) -> Array:
        return np.ascontiguousarray([get(i) for i in range(1, model.njoints)], dtype=float)

    parts = [  # Eigen's matrices are column-major
        each(lambda i: model.jointPlacements[i].rotation.T),
        each(lambda i: model.jointPlacements[i].translation),
        each(lambda i: model.inertias[i].mass),
        each(lambda i: model.inertias[i].lever),
        each(lambda i: model.inertias[i].inertia),
    ]
    loaded.functions.argtypes = [
        ctypes.c_void_p,
        ctypes.c_int,
        ctypes.c_long,
        *[ctypes.c_void_p] * 4,
    ]
    return loaded, loaded.make(model.nv, *(part.ctypes.data for part in parts))
