"""Messages of the wire protocol; `filter_service.messages` is their public API.

A *message* has a *header*, a msgpack map of its fields, and *parts*, which are images
or the body of a profile.  PROTOCOL.md is authoritative.

message   base class of messages, limits, bounded unpacking of untrusted bytes
images    image formats, encodings of depth, compression; headers of views
requests  messages from the client
replies   messages from the service
textures  messages about shared textures
"""
