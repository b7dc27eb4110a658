"""Messages of the wire protocol; `filter_service.messages` is their public API.

A *message* has a *header*, a msgpack map of its fields, and *parts*, which are images
or the body of a profile.  PROTOCOL.md is authoritative.

message      base class of messages; limits
images       image formats, headers of views, image parts
depths       depth encodings
compression  lossless compression of parts
requests     messages from the client
replies      messages from the service
textures     messages about shared textures
unpacking    bounded unpacking of untrusted bytes
"""
