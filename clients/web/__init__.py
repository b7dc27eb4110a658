"""A page in people's hands: `ocufilter web`.

program        the command
server         NiceGUI within a guard and limits, and a websocket for pictures
guard          who may open the page
bounds         limits on requests
connections    and on connections
page           the page, and what becomes of every entry
page_state     what a page holds, without the page
eye_panel      the entries of one eye
eye_form       what they say, and the profile that it makes
worn_form      what is worn, as entries
numbers        numbers that people type, with their limits
slider_row     a slider with its name and value
upload_entry   an entry for a file
file_names     names of files, made safe
scene_panel    what is looked at, chosen
picture        a picture with depth, in full and small
chart          a letter chart as a picture
scene_file     a scene rendered in a process apart
seen_view      scene and eye with a split between them; seen_view.js is its browser part
figure_panel   the point under the pointer, figures of the eye
eye_figures    those figures
point_spread   what the eye makes of one point, in colour
studying       the process beside the page that draws them
seeing         the thread that filters: of what is wished, the newest wins
eye_view       one eye: a quick small picture, then the full one
wishes         what is wanted, and what is shown
pictures_out   pictures on their way to the browser
picture_files  as files in memory

Slider to picture: `page` leaves a wish with `seeing`, which never runs on the page's
event loop; its thread hands pictures to `pictures_out`.  `EyeFilter` runs in this
process, as a service would add its two ways (of 1280 x 720 px, wire and queue: 1.1 ms
through shared memory, 4.5 ms over ipc, tests/benchmarks/results/roundtrip_*_mono.json)
and no gain: PSFs are built in a process of their own either way.
"""
