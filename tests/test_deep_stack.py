import threading

import pytest

from coopslam.estimation.deep_stack import ROOMY_ABOVE, call


@pytest.mark.parametrize("variables", [0, ROOMY_ABOVE + 1])
def test_results_and_errors_come_back(variables):
    assert call(divmod, 7, 2, variables=variables) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        call(divmod, 7, 0, variables=variables)


def test_a_deep_call_has_its_own_thread_and_leaves_the_stack_size_alone():
    before = threading.stack_size()
    assert call(threading.get_ident, variables=0) == threading.get_ident()
    assert call(threading.get_ident, variables=ROOMY_ABOVE + 1) != threading.get_ident()
    assert threading.stack_size() == before
