"""What gsfix writes, read by others; and what they write, read by gsfix. See formats.sh.
  .glb               by pygltflib, beside the PLY that it was made from, read by plyfile; colors as the extension's text defines
                     them, in glTF's axes
  .spz, 3 and 4      by gsply (zstandard for 4)
  COLMAP models      by pycolmap: cameras as text, filtered points
  transforms.json    by a reader made here from nerfstudio's documentation (docs.nerf.studio, "Data conventions"): nerfstudio's
                     own needs PyTorch

    formats.py GSFIX SCENE      SCENE: made by make_scene"""
import json
import os
import subprocess
import sys
import tempfile

import gsply
import numpy as np
import plyfile
import pycolmap
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


SPZ_AXES = np.array([1.0, -1.0, -1.0]) # SPZ's, of ours


def spz_signs():
    """Of the SH coefficients above band 0, from our axes to SPZ's."""
    d = np.array([0.3, 0.5, np.sqrt(0.66)])
    return np.rint(harmonics(d * SPZ_AXES) / harmonics(d))[1:]


def unit(quaternions):
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def same_turns(what, a, b, bar):
    check(what, np.minimum(np.abs(unit(a) - unit(b)).max(1), np.abs(unit(a) + unit(b)).max(1)).max(), bar)


def read_spz(gsfix, folder, version):
    """Ours, read by gsply: off by at most half a step of each number, or clamped to its range."""
    path, name = os.path.join(folder, "ours_%d.spz" % version), "spz %d: " % version
    subprocess.run([gsfix, "convert", PLY, "--out", path, "--spz-version", str(version)], check=True, stdout=subprocess.DEVNULL)
    ply, theirs = plyfile.PlyData.read(PLY)["vertex"], gsply.read_spz(path)
    check(name + "positions", np.abs(theirs.means * SPZ_AXES - positions(ply)).max(), 0.51 / 4096)
    check(name + "log-scales", np.abs(theirs.scales - columns(ply, "scale_", 3)).max(), 0.51 / 16)
    check(name + "opacities", np.abs(sigmoid(theirs.opacities.ravel()) - sigmoid(ply["opacity"])).max(), 0.51 / 255)
    same_turns(name + "rotations", theirs.quats * np.append(1.0, SPZ_AXES), columns(ply, "rot_", 4), 2.6e-3)
    most = 0.5 / 0.15
    check(name + "colors", np.abs(theirs.sh0.reshape(-1, 3) - np.clip(columns(ply, "f_dc_", 3), -most, most)).max(),
          0.51 / (0.15 * 255))
    rest = np.clip(columns(ply, "f_rest_", 45).reshape(-1, 3, 15).transpose(0, 2, 1), -1.0, 127 / 128)
    off = np.abs(theirs.shN * spz_signs()[None, :, None] - rest)
    check(name + "SH, band 1", off[:, :3].max(), 4.51 / 128) # 5 bits, then 4, of a number that was rounded to 8 before
    check(name + "SH, bands 2 and 3", off[:, 3:].max(), 8.51 / 128)
    return theirs


def write_spz(gsfix, folder, theirs, version):
    """gsply's, read by gsfix: the values that gsply reads itself."""
    path, out = os.path.join(folder, "theirs_%d.spz" % version), os.path.join(folder, "theirs_%d.ply" % version)
    name = "by gsply, %d: " % version
    gsply.write_spz(path, theirs, version=version)
    again = gsply.read_spz(path)
    subprocess.run([gsfix, "convert", path, "--out", out], check=True, stdout=subprocess.DEVNULL)
    ply = plyfile.PlyData.read(out)["vertex"]
    check(name + "positions", np.abs(again.means * SPZ_AXES - positions(ply)).max(), 1e-6)
    check(name + "log-scales", np.abs(again.scales - columns(ply, "scale_", 3)).max(), 1e-6)
    check(name + "opacities", np.abs(sigmoid(again.opacities.ravel()) - sigmoid(ply["opacity"])).max(), 1e-6)
    same_turns(name + "rotations", again.quats * np.append(1.0, SPZ_AXES), columns(ply, "rot_", 4), 1e-6)
    check(name + "colors", np.abs(again.sh0.reshape(-1, 3) - columns(ply, "f_dc_", 3)).max(), 1e-6)
    rest = columns(ply, "f_rest_", 45).reshape(-1, 3, 15).transpose(0, 2, 1)
    check(name + "SH", np.abs(again.shN * spz_signs()[None, :, None] - rest).max(), 1e-6)


def from_nerfstudio(frame, points):
    """Pixels of points in the world: transform_matrix is camera to world; the camera looks along -z, y is up."""
    c2w = np.array(frame["transform_matrix"])
    assert c2w.shape == (4, 4) and (c2w[3] == [0, 0, 0, 1]).all() and np.abs(np.linalg.det(c2w[:3, :3]) - 1) < 1e-9
    right, up, back = ((points - c2w[:3, 3]) @ c2w[:3, :3]).T
    return np.stack([frame["fl_x"] * right / -back + frame["cx"], -frame["fl_y"] * up / -back + frame["cy"]], 1)


def read_cameras(gsfix, folder, scene):
    """A path as our JSON, as transforms.json and as COLMAP's text: where points of the scene fall in the pictures."""
    colmap = os.path.join(folder, "colmap")
    os.mkdir(colmap)
    files = [os.path.join(folder, "path.json"), os.path.join(folder, "transforms.json"), os.path.join(colmap, "images.txt")]
    for file in files:
        subprocess.run([gsfix, "path", scene, "--views", "3", "--max-size", "91", "--frames", "12", "--out", file], check=True,
                       stdout=subprocess.DEVNULL)
    with open(files[0], encoding="utf-8") as file:
        ours = json.load(file)["cameras"]
    with open(files[1], encoding="utf-8") as file:
        nerfstudio = json.load(file)
    model = pycolmap.Reconstruction()
    model.read_text(colmap)
    images = sorted(model.images.values(), key=lambda image: image.name)
    assert len(ours) == len(images) == len(nerfstudio["frames"]) == 12 and nerfstudio["camera_model"] == "PINHOLE"
    rng, worst = np.random.default_rng(3), [0.0, 0.0]
    for camera, frame, image in zip(ours, nerfstudio["frames"], images):
        assert os.path.basename(frame["file_path"]) == image.name
        assert [frame["w"], frame["h"]] == [camera["width"], camera["height"]] == [image.camera.width, image.camera.height]
        w2c = np.array(camera["w2c"]).reshape(4, 4) # x is right, y down, z forward
        seen = np.column_stack([rng.uniform(-0.5, 0.5, (100, 2)), np.ones(100)]) * rng.uniform(1, 5, (100, 1))
        points = (seen - w2c[:3, 3]) @ w2c[:3, :3]
        pixels = seen[:, :2] / seen[:, 2:] * [camera["fx"], camera["fy"]] + [camera["cx"], camera["cy"]]
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        at = points @ pose.rotation.matrix().T + pose.translation
        worst[0] = max(worst[0], np.abs(from_nerfstudio(frame, points) - pixels).max())
        worst[1] = max(worst[1], np.abs(image.camera.img_from_cam(at) - pixels).max())
    check("transforms.json: pixels", worst[0], 1e-9)
    check("COLMAP text, by pycolmap: pixels", worst[1], 1e-9)


def read_model(gsfix, folder, scene):
    """A filtered model by pycolmap, beside the whole one; the whole one as pycolmap's text, by gsfix."""
    out, text = os.path.join(folder, "filtered"), os.path.join(folder, "text")
    subprocess.run([gsfix, "filter", scene, "--views", "3", "--method", "tracks", "--out", out], check=True,
                   stdout=subprocess.DEVNULL)
    whole = pycolmap.Reconstruction(os.path.join(scene, "sparse", "0"))
    part = pycolmap.Reconstruction(os.path.join(out, "sparse", "0"))
    assert 0 < len(part.points3D) < len(whole.points3D)
    for i, point in part.points3D.items():
        assert (point.xyz == whole.points3D[i].xyz).all() and (point.color == whole.points3D[i].color).all()
    poses = {image.name: image.cam_from_world().matrix() for image in whole.images.values()}
    check("filtered model, by pycolmap: poses",
          max(np.abs(image.cam_from_world().matrix() - poses[image.name]).max() for image in part.images.values()), 1e-15)
    os.makedirs(os.path.join(text, "sparse", "0"))
    os.symlink(os.path.join(os.path.abspath(scene), "images"), os.path.join(text, "images"))
    whole.write_text(os.path.join(text, "sparse", "0"))
    paths = []
    for source in (scene, text):
        paths.append(os.path.join(folder, "path_%d.json" % len(paths)))
        subprocess.run([gsfix, "path", source, "--views", "3", "--frames", "12", "--out", paths[-1]], check=True,
                       stdout=subprocess.DEVNULL)
    both = [np.array([c["w2c"] for c in json.load(open(path, encoding="utf-8"))["cameras"]]) for path in paths]
    check("model as pycolmap's text, by gsfix: a path", np.abs(both[0] - both[1]).max(), 1e-12)


with tempfile.TemporaryDirectory() as scratch:
    read_ours(sys.argv[1], scratch)
    write_theirs(sys.argv[1], scratch)
    for number in (3, 4):
        write_spz(sys.argv[1], scratch, read_spz(sys.argv[1], scratch, number), number)
    read_cameras(sys.argv[1], scratch, sys.argv[2])
    read_model(sys.argv[1], scratch, sys.argv[2])
sys.exit(failed)
