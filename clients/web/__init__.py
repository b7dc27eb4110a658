"""Interactive page in the browser: `ocufilter web`.

program           the command
server            HTTP server: app, token authentication, limits, image websocket
guard             access control by token
bounds            limits on requests
connections       limits on connections
page              the page: layout and event handlers
page_state        state of a page, independent of the layout
eye_panel         the entries of one eye
eye_form          their values, and the resulting profile
correction_form   the entries of a correction, and the resulting correction
numbers           numeric entries with their limits
slider_row        a slider with its name and value, with range_slider.js
shared_entries    the entries as the fragment of an address
page_link         the browser's address, and the link to copy
downloads         buttons that download picture, profile and report
upload_entry      a file upload
file_names        sanitized file names
scene_panel       selection of the scene
picture           a picture with depth, at full and preview size
chart             a letter chart as a picture
scene_file        a scene rendered in a child process
picture_view      scene and filtered picture with a split, with picture_view.js
figure_panel      point-spread function under the pointer, and figures of the eye
eye_figures       figures of the eye as PNG
point_spread      point-spread function of one point, in color
figure_worker     worker process that draws them
filter_thread     filter thread; newer requests replace older ones
eye_view          one eye: a fast preview, then the full picture
picture_requests  the requested state, and the pictures returned
picture_sender    sends pictures to the browser
picture_files     pictures encoded in memory

From slider to picture: `page` passes a request to `filter_thread`, which never runs on
the page's event loop; its thread passes pictures to `picture_sender`. `EyeFilter` runs
in this process: a service would add the transfer in both directions (for 1280 x 720 px,
wire and queue: 1.1 ms through shared memory, 4.5 ms over ipc,
tests/benchmarks/results/roundtrip_*_mono.json) and gain nothing, as PSFs are built in
a process of their own either way.
"""
