"""The scene of the tests in Blender's VR session; ends with a signal.

blender --factory-startup --python vr.py
"""

import bpy

EYE_M = 1.6


def add(name, vertices, faces, rgb):
    """Add an object of one color; axes are right, forward, up."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*rgb, 1)
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))


def add_stripes(count, width_m, height_m, distance_m, middle_m):
    """Add upright stripes, of which every second one is dark."""
    for first, light in enumerate((0.014, 0.87)):
        vertices = []
        for i in range(first, count, 2):
            left_m = (i - count / 2) * width_m
            for x_m, y in ((0, -1), (width_m, -1), (width_m, 1), (0, 1)):
                up_m = EYE_M + middle_m + 0.5 * y * height_m
                vertices.append((left_m + x_m, distance_m, up_m))
        faces = [range(i, i + 4) for i in range(0, len(vertices), 4)]
        add("stripes", vertices, faces, (light,) * 3)


CORNERS = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
FACES = [
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
]


def add_box(at_m, side_m, rgb):
    """Add a cube."""
    vertices = [
        [a + 0.5 * side_m * b for a, b in zip(at_m, corner, strict=True)]
        for corner in CORNERS
    ]
    add("box", vertices, FACES, rgb)


def make_scene():
    """Replace the startup scene."""
    for old in list(bpy.data.objects):
        bpy.data.objects.remove(old)
    add_stripes(100, 0.08, 2.0, 6.0, 1.25)
    add_stripes(60, 0.0035, 0.05, 0.25, -0.04)
    add_box((-0.25, 1, EYE_M - 0.4), 0.2, (0.63, 0.014, 0.014))
    add_box((0.25, 1, EYE_M - 0.4), 0.2, (0.014, 0.05, 0.63))


def session_area():
    """Return a window with a 3D view, for operators."""
    window = bpy.context.window_manager.windows[0]
    areas = window.screen.areas
    area = next(area for area in areas if area.type == "VIEW_3D")
    return bpy.context.temp_override(window=window, area=area)


def start():
    """Begin the session."""
    with session_area():
        make_scene()
        bpy.ops.preferences.addon_enable(module="viewport_vr_preview")
        settings = bpy.context.window_manager.xr_session_settings
        settings.clip_start, settings.clip_end = 0.05, 100
        settings.use_absolute_tracking = True
        settings.use_positional_tracking = True
        settings.base_pose_type = "CUSTOM"
        settings.base_pose_location = (0, 0, EYE_M)
        settings.base_pose_angle = 0
        for extra in ("floor", "annotation", "controllers", "custom_overlays"):
            setattr(settings, f"show_{extra}", False)
        settings.show_selection = False
        settings.shading.color_type = "MATERIAL"
        bpy.ops.wm.xr_session_toggle()


bpy.app.timers.register(start, first_interval=1.0)
