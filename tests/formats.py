"""Splats written by gsfix as .glb, read by pygltflib, beside the PLY that they were made from, read by plyfile; and the other
way round. Colors are compared as the extension's text defines them, in glTF's axes. See formats.sh.

    formats.py GSFIX"""
import os
import subprocess
import sys
import tempfile

import numpy as np
import plyfile
import pygltflib

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
PLY = os.path.join(ROOT, "tests/golden/splat/ply/random_deg3.ply")
NAME = "KHR_gaussian_splatting"
AXES = np.array([-1.0, -1.0, 1.0]) # glTF's, of ours
failed = False


def check(what, error, bar):
    global failed
    failed |= not error <= bar
    print("%-44s %9.2e   at most %7.1e%s" % (what, error, bar, "" if error <= bar else "   FAILED"))


def harmonics(d):
    """The extension's appendix, at a unit direction."""
    x, y, z = d
    return np.array([
        0.2820947917738781, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.092548430592079 * x * y, -1.092548430592079 * y * z, 0.3153915652525200 * (2 * z * z - x * x - y * y),
        -1.092548430592079 * x * z, 0.5462742152960395 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644657 * y * (4 * z * z - x * x - y * y), 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644657 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y)])


def columns(vertex, stem, count):
    return np.stack([vertex["%s%d" % (stem, i)] for i in range(count)], 1).astype(np.float64)


def positions(vertex):
    return np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float64)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-np.asarray(x, np.float64)))


def accessor(gltf, attributes, name):
    a = gltf.accessors[getattr(attributes, name)]
    view = gltf.bufferViews[a.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a.type]
    kind = {5126: np.float32, 5123: np.uint16}[a.componentType]
    at = (view.byteOffset or 0) + (a.byteOffset or 0)
    return np.frombuffer(gltf.binary_blob(), kind, a.count * width, at).reshape(-1, width).astype(np.float64), a


def read_ours(gsfix, folder):
    path = os.path.join(folder, "ours.glb")
    subprocess.run([gsfix, "convert", PLY, "--out", path], check=True, stdout=subprocess.DEVNULL)
    ply, gltf = plyfile.PlyData.read(PLY)["vertex"], pygltflib.GLTF2().load(path)
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == 0 and gltf.extensionsUsed == [NAME]
    assert primitive.extensions[NAME] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    column = lambda name: accessor(gltf, primitive.attributes, name)[0]
    points, info = accessor(gltf, primitive.attributes, "POSITION")
    check("glb: positions", np.abs(points * AXES - positions(ply)).max(), 0.0)
    check("glb: their bounds", max(np.abs(points.min(0) - info.min).max(), np.abs(points.max(0) - info.max).max()), 1e-6)
    check("glb: scales, relative", np.abs(column(NAME + ":SCALE") / np.exp(columns(ply, "scale_", 3)) - 1).max(), 2e-7)
    check("glb: opacities", np.abs(column(NAME + ":OPACITY")[:, 0] - sigmoid(ply["opacity"])).max(), 1e-7)
    wanted, turned = columns(ply, "rot_", 4), column(NAME + ":ROTATION")
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    check("glb: rotations", np.abs(np.column_stack([turned[:, 3], turned[:, :3] * AXES]) - wanted).max(), 2e-7)
    check("glb: lengths of rotations", np.abs(np.linalg.norm(turned, axis=1) - 1).max(), 3e-7)
    stored = np.stack([column("%s:SH_DEGREE_%d_COEF_%d" % (NAME, l, k)) for l in range(4) for k in range(2 * l + 1)], 1)
    rest = columns(ply, "f_rest_", 45).reshape(-1, 3, 15).transpose(0, 2, 1)
    expected = np.concatenate([columns(ply, "f_dc_", 3)[:, None], rest], 1)
    worst = 0.0
    for d in np.random.default_rng(1).normal(size=(50, 3)):
        d /= np.linalg.norm(d)
        there = np.einsum("k,nkc->nc", harmonics(d * AXES), stored)
        worst = max(worst, np.abs(there - np.einsum("k,nkc->nc", harmonics(d), expected)).max())
    check("glb: colors in 50 directions", worst, 1e-12)
    rgb = np.clip(0.5 + 0.2820947917738781 * expected[:, 0], 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    check("glb: COLOR_0, linear", np.abs(column("COLOR_0")[:, :3] / 65535 - linear).max(), 0.51 / 65535)


def write_theirs(gsfix, folder):
    rng, n = np.random.default_rng(2), 500
    turns = rng.normal(size=(n, 4))
    arrays = {"POSITION": rng.normal(size=(n, 3)), NAME + ":ROTATION": turns / np.linalg.norm(turns, axis=1, keepdims=True),
              NAME + ":SCALE": np.exp(rng.normal(size=(n, 3))), NAME + ":OPACITY": rng.uniform(0.01, 0.99, size=(n, 1)),
              NAME + ":SH_DEGREE_0_COEF_0": rng.normal(size=(n, 3))}
    gltf, attributes, blob = pygltflib.GLTF2(), pygltflib.Attributes(), b""
    for i, (name, values) in enumerate(arrays.items()):
        arrays[name] = values = values.astype(np.float32)
        gltf.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=values.nbytes))
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        gltf.accessors.append(pygltflib.Accessor(bufferView=i, componentType=5126, count=n, type=kind))
        setattr(attributes, name, i)
        blob += values.tobytes()
    extension = {NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    gltf.meshes = [pygltflib.Mesh(primitives=[pygltflib.Primitive(attributes=attributes, mode=0, extensions=extension)])]
    gltf.nodes, gltf.scenes, gltf.scene = [pygltflib.Node(mesh=0)], [pygltflib.Scene(nodes=[0])], 0
    gltf.extensionsUsed, gltf.buffers = [NAME], [pygltflib.Buffer(byteLength=len(blob))]
    gltf.set_binary_blob(blob)
    gltf.save(os.path.join(folder, "theirs.glb"))
    out = os.path.join(folder, "theirs.ply")
    subprocess.run([gsfix, "convert", os.path.join(folder, "theirs.glb"), "--out", out], check=True, stdout=subprocess.DEVNULL)
    ply = plyfile.PlyData.read(out)["vertex"]
    check("by pygltflib: positions", np.abs(positions(ply) - arrays["POSITION"] * AXES).max(), 0.0)
    check("by pygltflib: scales, relative", np.abs(np.exp(columns(ply, "scale_", 3)) / arrays[NAME + ":SCALE"] - 1).max(), 3e-7)
    check("by pygltflib: opacities", np.abs(sigmoid(ply["opacity"]) - arrays[NAME + ":OPACITY"][:, 0]).max(), 1e-7)
    turned = arrays[NAME + ":ROTATION"]
    wanted = np.column_stack([turned[:, 3], turned[:, :3] * AXES])
    check("by pygltflib: rotations", np.abs(columns(ply, "rot_", 4) - wanted).max(), 0.0)
    check("by pygltflib: colors", np.abs(columns(ply, "f_dc_", 3) - arrays[NAME + ":SH_DEGREE_0_COEF_0"]).max(), 0.0)


with tempfile.TemporaryDirectory() as scratch:
    read_ours(sys.argv[1], scratch)
    write_theirs(sys.argv[1], scratch)
sys.exit(failed)
