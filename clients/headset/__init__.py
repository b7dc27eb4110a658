"""Scenes seen through two eyes in an OpenXR headset: `ocufilter headset`.

program            the command
options            its command-line options
viewer             the main loop: render, follow the eyes, filter, show
controls           run-time switches, set by keys or controller buttons
runtime            interface of headset runtimes, real or simulated
openxr_runtime     OpenXR runtime
openxr_gl          OpenGL contexts for OpenXR
openxr_swapchains  swapchain images and projection layers
openxr_actions     controller buttons and the eye tracker
simulated_runtime  simulated runtime, without a headset
poses              positions and orientations
stereo_gaze        gaze, focus and pupils of both eyes
stereo_filter      frames before and after filtering, and the interface of filters
local_filter       filter in this process
service_filter     filter through a service
scenery            renders a scene for both eyes
presenter          draws images into the headset's swapchain images
gltf_container     header and buffers of a glTF file
gltf_arrays        arrays of a glTF file
gltf_nodes         node tree of a glTF file
gltf_file          triangles of a glTF file, part by part
gltf_scene         a glTF file as a scene
viewpoint          the viewer's initial position in a scene

Modules here must not import PyOpenGL: pyopenxr makes PyOpenGL use GLX.
"""
