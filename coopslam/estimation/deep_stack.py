"""Room for recursion: iSAM2 descends its Bayes tree by recursion, and the tree of a long run is a long chain."""

import threading

STACK_BYTES = 1 << 30  # address space, not memory: only what is used is ever mapped
ROOMY_ABOVE = 12_000  # pose variables; an 8 MB stack has been seen to end at some 30 000


def call(function, *arguments, variables: int):
    """function(*arguments), on a deep stack when there are many variables; costs 0.1 ms then."""
    if variables <= ROOMY_ABOVE:
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
