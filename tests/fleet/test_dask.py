"""A cluster of Dask takes the work like any executor: here its local one, with two workers."""

import pytest
from test_execution import KillOnce

from smartview_jax.fleet import outcomes

distributed = pytest.importorskip("distributed")


def test_a_killed_worker_costs_nothing_but_time(tmp_path):
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with cluster, distributed.Client(cluster) as client:
        executor = client.get_executor()
        found = {one.number: one for one in outcomes(KillOnce(tmp_path), range(5), executor)}
    assert (tmp_path / "killed").exists()
    assert [found[number].result[0] for number in (0, 1, 3, 4)] == [0, 1, 3, 4]
    assert str(found[2].error) == "ParticularError: one and two"
