"""Scenes through a person's two eyes in an OpenXR headset: `ocufilter headset`.

program            the command
options            its command line
viewer             the main loop: render, follow the eyes, filter, show
controls           switches that keys and controller buttons set at run time
keys               single keys from a terminal
runtime            interface of a headset runtime, real or simulated
openxr_runtime     OpenXR runtime
openxr_gl          OpenGL contexts for OpenXR
openxr_swapchains  swapchain images and projection layers
openxr_actions     controller buttons and the eye tracker
simulated_runtime  simulated runtime, without a headset
poses              positions and orientations
stereo_gaze        gaze, focus and pupils of both eyes
stereo_filter      frames before and after the filter; interface of the filters
local_filter       filter in this process
service_filter     filter through a service
scenery            renders a scene for both eyes
presenter          draws pictures into the headset's images
scene_view         renders a scene's color and depth in an OpenGL context
scene_buffers      its OpenGL objects
projection         its matrices
built_scene        the built-in scenes, built in a child process
gltf_container     header and buffers of a glTF file
gltf_arrays        its arrays
gltf_nodes         its node tree
gltf_file          its triangles, part by part
gltf_scene         a glTF file as a scene
viewpoint          the viewer's initial position in a scene

Modules here must not import PyOpenGL or pyrender: pyopenxr makes PyOpenGL use GLX.
"""
