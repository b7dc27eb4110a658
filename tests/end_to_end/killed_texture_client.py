"""A client that shares textures and submits a frame, until a test kills it."""

import sys

from clients.filter_client import FilterClient
from filter_service.messages import ViewTextures
from tests.end_to_end.exported_textures import exporting_context
from tests.end_to_end.test_shared_textures import CAMERA, SEE, SIZE_PX

if __name__ == "__main__":
    with FilterClient(sys.argv[1], timeout_s=30.0) as client, exporting_context() as gl:
        client.set_profile("myopia", views=[CAMERA])
        kinds = ("rgba8", "r32f", "rgba8")
        numbers = [gl.new(kind, SIZE_PX).share(client) for kind in kinds]
        print("shared", flush=True)
        sys.stdin.readline()
        client.submit([(CAMERA, ViewTextures(*numbers))], **SEE)
        print("sent", flush=True)
        sys.stdin.readline()
