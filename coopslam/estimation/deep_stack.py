"""Room for recursion: iSAM2 descends its Bayes tree by recursion, and the tree of a long run is a long chain."""

import threading

try:
    import resource
except ImportError:  # no such limit on this system
    resource = None

STACK_BYTES = 1 << 30  # address space, not memory: only what is used is ever mapped
ROOMY_ABOVE = 12_000  # pose variables on the usual stack; it has been seen to end at some 30 000
_USUAL_STACK_BYTES = 8 << 20
_BYTES_PER_VARIABLE = _USUAL_STACK_BYTES // ROOMY_ABOVE


def call(function, *arguments, variables: int):
    """function(*arguments), on a deep stack when there are many variables; costs 0.1 ms then."""
    if variables <= _own_stack_bytes() // _BYTES_PER_VARIABLE:
        return function(*arguments)
    outcome = []

    def work():
        try:
            outcome.append((function(*arguments), None))
        except BaseException as error:  # noqa: BLE001 - handed over to the caller's thread
            outcome.append((None, error))

    former = threading.stack_size(STACK_BYTES)
    try:
        thread = threading.Thread(target=work)
        thread.start()
    finally:
        threading.stack_size(former)
    thread.join()
    result, error = outcome[0]
    if error is not None:
        raise error
    return result


def _own_stack_bytes() -> int:
    """Stack of the thread that asks, at most the usual: the limit of the process also sizes its threads."""
    stack = _USUAL_STACK_BYTES
    if resource is not None:
        limit, _ = resource.getrlimit(resource.RLIMIT_STACK)
        if limit != resource.RLIM_INFINITY:
            stack = min(stack, limit)
    if threading.current_thread() is not threading.main_thread() and threading.stack_size():
        stack = min(stack, threading.stack_size())
    return stack
