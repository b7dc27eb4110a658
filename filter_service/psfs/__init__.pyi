from .eye_for_spec import eye_for_spec as eye_for_spec
from .frame_layers import frame_layers as frame_layers
from .store import PsfStore as PsfStore
from .store import build_psf_store as build_psf_store
from .store_cache import StoreCache as StoreCache
