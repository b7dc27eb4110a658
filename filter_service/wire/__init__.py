"""Messages, field by field; `filter_service.messages` is their face.

message    what every message has in common
images     images, formats, views
depths     depth in fewer bytes
compression  parts in fewer, without loss
requests   what a client says
replies    what the service answers
unpacking  bounded unpacking of untrusted bytes
"""
