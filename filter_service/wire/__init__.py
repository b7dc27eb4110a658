"""Messages of the wire protocol; `filter_service.messages` is their public API.

message    base class of messages, limits
images     images, formats, views
depths     depth encodings
compression  lossless compression of parts
requests   messages from the client
replies    messages from the service
unpacking  bounded unpacking of untrusted bytes
"""
