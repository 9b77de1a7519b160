import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from smartview_jax.runtime import blas_threads
from smartview_jax.runtime.blas_threads import on_one_blas_thread


def thread_counts():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


@pytest.fixture
def two_threads():
    with threadpool_limits(limits=2, user_api="blas"):
        before = thread_counts()
        if not before or 2 not in before:
            pytest.skip("this machine's BLAS has one thread only")
        yield before


def test_a_function_runs_on_one_thread_and_leaves_the_rest_as_it_was(two_threads):
    @on_one_blas_thread
    def product(x, scale=1.0):
        assert set(thread_counts()) == {1}
        return scale * (x @ x)

    np.testing.assert_array_equal(product(np.eye(2), scale=3.0), 3.0 * np.eye(2))
    assert thread_counts() == two_threads
    assert product.__name__ == "product"


def test_an_error_leaves_the_threads_as_they_were_too(two_threads):
    @on_one_blas_thread
    def fail():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert thread_counts() == two_threads


def test_the_limit_is_set_once_for_functions_within_functions(two_threads, monkeypatch):
    limits = []
    controller = blas_threads._controller()

    def counted(**options):
        limits.append(options)
        return threadpool_limits(**options)

    monkeypatch.setattr(controller, "limit", counted)

    @on_one_blas_thread
    def inner():
        assert set(thread_counts()) == {1}

    @on_one_blas_thread
    def outer():
        inner()
        inner()

    outer()
    assert len(limits) == 1
    assert thread_counts() == two_threads
    # A later call sets it again.
    inner()
    assert len(limits) == 2
