"""The compiled kernel: own C++20 without torch headers (`csrc/`), its instruction sets and its threads."""

from graings.kernel.extension import active_isa as active_isa
from graings.kernel.extension import available_isas as available_isas
from graings.kernel.extension import call as call
from graings.kernel.extension import has_bfloat16_products as has_bfloat16_products
from graings.kernel.extension import keep_freed_memory as keep_freed_memory
from graings.kernel.extension import kernel as kernel
from graings.kernel.extension import use_isa as use_isa
from graings.kernel.threads import computing_threads as computing_threads
from graings.kernel.threads import set_threads as set_threads
from graings.kernel.threads import thread_count as thread_count
from graings.kernel.threads import usable_cores as usable_cores
from graings.kernel.threads import use_threads as use_threads
