from .compute import PsfBatch as PsfBatch
from .compute import PsfTooLarge as PsfTooLarge
from .compute import compute_psf_batch as compute_psf_batch
from .compute import compute_psfs as compute_psfs
from .kernel_types import Psf as Psf
from .stiles_crawford import StilesCrawford as StilesCrawford
