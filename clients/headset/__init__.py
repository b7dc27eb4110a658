"""A scene through a person's two eyes in an OpenXR headset: `ocufilter headset`.

program            the command
options            what it is told
viewer             its loop: render, look, filter, show, whatever the headset does
controls           what it can be told while it runs
keys               single keys from a terminal
runtime            what it asks of a headset, real or simulated
openxr_runtime     a real one
openxr_gl          its OpenGL
openxr_swapchains  its images, and the layers made of them
openxr_actions     its controllers and its eye tracker
simulated_runtime  one that is not there
poses              positions and orientations
look               gaze, focus and pupils of both eyes
seeing             what eyes are given, and what they see of it
seeing_here        filtered in this process
seeing_by_service  or by a service
scenery            both eyes' pictures of a scene
presenting         pictures into a headset's images
scene_view         a scene's colour and depth in an OpenGL context
scene_buffers      what that keeps there
projection         its matrices
built_scene        our own scenes, built in a process apart
gltf_container     a glTF file's header and buffers
gltf_arrays        its arrays
gltf_nodes         where its meshes stand
gltf_file          all of it, in parts
gltf_scene         as a scene
viewpoint          where a viewer stands in it

Nothing here may import PyOpenGL or pyrender: pyopenxr makes PyOpenGL use GLX.
"""
