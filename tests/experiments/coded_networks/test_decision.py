"""What coded networks buy: the table compares rows of one scene and seed."""

from tutorials.experiments.coded_networks import decision
from tutorials.experiments.tables.methods import CODED, PAPERS


def row(method, seed, price, size, psnr):
    names = ("method", "scene", "seed", "lambda_rate", "bytes", "psnr_db", "deformation_bytes")
    return dict(zip(names, (method, "bouncing", seed, price, size, psnr, size / 10)))


def test_changes_are_against_the_papers_design_of_the_same_seed(tmp_path):
    papers = [row(PAPERS, seed, 5e-4, size, 33) for seed, size in enumerate((1000, 2000))]
    coded = [row(CODED, seed, 5e-4, 200, 33 - seed) for seed in (0, 1)]
    more = [row(CODED, 0, 2.5e-4, 500, 33.5)]
    _, usual, cheap, both, one = decision.table(papers + coded + more)
    cells = "200 (200 to 200) 0.150 (0.100 to 0.200) -0.50 (-1.00 to +0.00) 20 (20 to 20)"
    assert usual.split() == ["0.0005", "bouncing", *cells.split()]
    assert both.split() == ["0.0005", "all", *cells.split()]
    assert cheap.split()[:6] == ["0.00025", "bouncing", "500", "(500", "to", "500)"]
    decision.draw(papers + coded, tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 5000


def test_the_plan_is_three_designs_on_three_scenes_with_three_seeds():
    tasks = decision.plan()
    assert len({task.key for task in tasks}) == len(tasks) == 27
    assert [task.method for task in tasks].count(CODED) == 18
