"""Interactive page in the browser: `ocufilter web`.

program        the command
server         HTTP server: app, image websocket, limits on connections
guard          access control by token, limits on requests
page           the page: layout and event handlers
header         downloads, and the link in the browser's address
page_texts     explanations on the page
page_state     state of a page, independent of the layout
page_link      the entries of a page as text, for links
controls       the numbers that can be entered, with limits, steps, initial values
written        those numbers as people write them
comparison     states A and B of one person: names, differences, a joined picture
eye_form       entries of an eye and its correction, and the resulting profile
correction_hints  what a correction does, and its additions in spectacles
eye_panel      those entries on the page
eyes_card      which eyes and states are shown, with the panels of their entries
scenario_menu  scenarios, each with its scene, conditions, and states A and B
sight          how well an eye reads at a distance, in a sentence
blur_widths    angular sizes of familiar things, for the width of a blur
picture        pictures with depth: scenes, glTF files, photos, a letter chart
picture_panel  scene and filtered picture with a split, with picture_view.js
figure_panel   point-spread function under the pointer, and figures of the eye
figure_worker  worker process that draws them
filter_thread  filter thread; newer requests replace older ones
widgets        sliders, with range_slider.js, uploads and choices

From slider to picture: `page` passes a request to `filter_thread`, which never runs on
the page's event loop; its thread passes pictures to the `PictureSender`. `EyeFilter`
runs in this process: a service would add the transfer in both directions (for 1280 x
720 px, wire and queue: 1.1 ms through shared memory, 4.5 ms over ipc, `ocufilter bench
latency`) and gain nothing, as PSFs are built in a separate process either way.
"""
