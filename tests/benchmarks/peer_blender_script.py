"""Runs inside Blender: blurs pictures through its compositor (`peer_blender`).

    blender -b --factory-startup --python peer_blender_script.py -- FOLDER MODE COUNT

For each job k of COUNT reads FOLDER/color_k.npy (height, width, 4) and radius_k.npy
(height, width), and writes out_k.npy and the seconds of the compositing, seconds_k.txt.
MODE is "bokeh" or "defocus".  Nothing but numpy and bpy: Blender has its own Python.
"""

import sys
import time
from pathlib import Path

import bpy
import numpy as np


def new_image(name, values):
    """Image of linear floats; Blender's rows go upwards."""
    height, width = values.shape[:2]
    image = bpy.data.images.new(
        name, width, height, alpha=True, float_buffer=True, is_data=True
    )
    image.pixels.foreach_set(np.ascontiguousarray(values[::-1], np.float32).ravel())
    image.update()
    image.pack()
    return image


def node_tree(scene):
    """Give back the empty tree of a scene, and the node that shows its result."""
    if hasattr(scene, "compositing_node_group"):  # 5.0 and later
        tree = bpy.data.node_groups.new("peers", "CompositorNodeTree")
        tree.interface.new_socket(
            "Image", in_out="OUTPUT", socket_type="NodeSocketColor"
        )
        scene.compositing_node_group = tree
        return tree, tree.nodes.new("NodeGroupOutput")
    scene.use_nodes = True
    scene.node_tree.nodes.clear()
    return scene.node_tree, scene.node_tree.nodes.new("CompositorNodeComposite")


def blur_node(tree, mode, most):
    """Node of the blur that looks as far as ``most`` px, and its input for radii."""
    if mode == "defocus":
        node = tree.nodes.new("CompositorNodeDefocus")
        node.use_zbuffer, node.z_scale, node.blur_max = False, 1.0, most
        node.bokeh = "CIRCLE"
        return node, node.inputs["Z"]
    node = tree.nodes.new("CompositorNodeBokehBlur")
    if hasattr(node, "use_variable_size"):  # before 5.0
        node.use_variable_size, node.blur_max = True, most
    bokeh = tree.nodes.new("CompositorNodeBokehImage")
    if "Roundness" in bokeh.inputs:
        bokeh.inputs["Roundness"].default_value = 1.0
    else:
        bokeh.rounding = 1.0
    tree.links.new(bokeh.outputs[0], node.inputs["Bokeh"])
    return node, node.inputs["Size"]


def blurred(folder, mode, k):
    """Do one job."""
    color = np.load(folder / f"color_{k}.npy")
    radius = np.load(folder / f"radius_{k}.npy")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.resolution_y, scene.render.resolution_x = radius.shape
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.filepath = str(folder / f"out_{k}.exr")
    tree, output = node_tree(scene)
    node, radius_input = blur_node(tree, mode, float(np.ceil(radius.max())))
    for name, values, socket in (
        ("color", color, node.inputs["Image"]),
        ("radius", np.repeat(radius[..., None], 4, axis=2), radius_input),
    ):
        source = tree.nodes.new("CompositorNodeImage")
        source.image = new_image(name, values)
        tree.links.new(source.outputs["Image"], socket)
    tree.links.new(node.outputs["Image"], output.inputs[0])
    start_s = time.perf_counter()
    bpy.ops.render.render(write_still=True)
    taken_s = time.perf_counter() - start_s
    found = bpy.data.images.load(scene.render.filepath)
    found.colorspace_settings.name = "Non-Color"
    pixels = np.empty(color.size, np.float32)
    found.pixels.foreach_get(pixels)
    np.save(folder / f"out_{k}.npy", pixels.reshape(color.shape)[::-1])
    (folder / f"seconds_{k}.txt").write_text(repr(taken_s))


if __name__ == "__main__":
    FOLDER, MODE, COUNT = sys.argv[sys.argv.index("--") + 1 :]
    for job in range(int(COUNT)):
        blurred(Path(FOLDER), MODE, job)
