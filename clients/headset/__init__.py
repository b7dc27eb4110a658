"""Scenes seen through two eyes in an OpenXR headset: `ocufilter headset`.

program         the command
options         its command-line options
viewer          the main loop: render, follow the eyes, filter, show; run-time switches
runtime         interface of headset runtimes, poses, and a simulated runtime
openxr_runtime  OpenXR runtime, controller buttons and the eye tracker
openxr_gl       OpenGL contexts, swapchain images and projection layers for OpenXR
stereo_gaze     gaze, focus and pupils of both eyes
stereo_filter   frames before and after filtering; filters in this process and a service
scenery         a scene for both eyes, the viewer's position, images in the headset
gltf_file       header, buffers and arrays of a glTF file
gltf_scene      a glTF file as a scene

Modules here must not import PyOpenGL: pyopenxr makes PyOpenGL use GLX.
"""
