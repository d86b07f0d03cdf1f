"""The handout: the drawing and the 17 equations with their gradients on one page of paper.

`python -m tutorials.tools.syllabus` writes it to tutorials/handout.pdf. The gradients are those of
the `backward` functions; a test notices where one of them is edited.
"""

from collections import namedtuple

from matplotlib.patches import Rectangle

from p4dgs_ref.report.figures import figure_style, new_figure
from tutorials.tools import architecture
from tutorials.tools.figures import STYLE

PAGE = (8.27, 11.69)  # inches: A4
MARGIN = 0.42
DRAWING = PAGE[0] - 2 * MARGIN  # width
SMALLEST = 7.0  # points


# One equation: its formula and the gradients of its inputs, in mathtext.
Row = namedtuple("Row", "key formula gradients")

ROWS = (
    Row(
        "offsets",
        r"$x_i = x_a + O_i\, l_a$",
        r"$\bar x_a = \sum_i \bar x_i \qquad \bar O_i = \bar x_i\, l_a \qquad "
        r"\bar l_a = \sum_i \bar x_i\, O_i$",
    ),
    Row(
        "view",
        r"$\delta_{vc} = |x_a - x_c|, \quad d_{vc} = (x_a - x_c)\,/\,\delta_{vc}$",
        r"$\bar x_a = d_{vc}\,\bar\delta_{vc} + "
        r"(\bar d_{vc} - d_{vc}\,(d_{vc} \cdot \bar d_{vc}))\,/\,\delta_{vc}$",
    ),
    Row(
        "opacity",
        r"$\alpha = \tanh \psi_\alpha(f_a, \delta_{vc}, d_{vc})$",
        r"$\bar\psi_\alpha = \bar\alpha\,(1 - \alpha^2)$",
    ),
    Row(
        "color",
        r"$c = \mathrm{sigmoid}\,\psi_c(f_a, \delta_{vc}, d_{vc})$",
        r"$\bar\psi_c = \bar c\;c\,(1 - c)$",
    ),
    Row(
        "rotation",
        r"$r = \psi_r\,/\,|\psi_r|$",
        r"$\bar\psi_r = (\bar r - r\,(r \cdot \bar r))\,/\,|\psi_r|$",
    ),
    Row(
        "scale",
        r"$s_i = s_a\,g_i, \quad g = \mathrm{sigmoid}\,\psi_s(f_a, \delta_{vc}, d_{vc})$",
        r"$\bar s_a = \sum_i \bar s_i\,g_i \qquad \bar\psi_{s,i} = \bar s_i\,s_a\,g_i\,(1 - g_i)$",
    ),
    Row(
        "mlp",
        r"networks: $y = x_1 W + b, \quad x_1 = \max(0, z)$",
        r"$\bar W = x_1^T \bar y \qquad \bar b = \sum_{rows} \bar y \qquad "
        r"\bar z = (\bar y\,W^T)\,[z > 0]$",
    ),
    Row(
        "deformation",
        r"$(\Delta x, \Delta s, \Delta r) = \psi_d(\mathcal{E}(x), \mathcal{E}(t))$",
        r"$\bar\psi_d = (\overline{\Delta x}, \overline{\Delta s}, \overline{\Delta r})$;"
        r" the pipeline sends nothing through $\mathcal{E}(x)$ to $x$",
    ),
    Row(
        "deformed",
        r"$x' = x + \Delta x, \; s' = s + \Delta s, \; r' = (r + \Delta r)\,/\,|r + \Delta r|$",
        r"$\bar x = \overline{\Delta x} = \bar x' \quad \bar s = \overline{\Delta s} = \bar s' "
        r"\quad \bar r = \overline{\Delta r} = "
        r"(\bar r' - r'\,(r' \cdot \bar r'))\,/\,|r + \Delta r|$",
    ),
    Row(
        "noise",
        r"$\tilde f = f + u\,q$",
        r"$\bar f = \overline{\tilde f} \qquad \bar q = \sum_n u_n\,\overline{\tilde f}_n$",
    ),
    Row(
        "step",
        r"$q = Q_0\,(1 + \tanh \psi_q(h)) \geq 2^{-10} Q_0$",
        r"$\bar\psi_q = \bar q\,Q_0\,(1 - \tanh^2 \psi_q)$, and 0 on the floor",
    ),
    Row(
        "hash_grid",
        r"$h_l = \sum_c w_c\,\mathrm{sign}\,\theta^l_{i(c)}$",
        r"$\bar\theta^l_j = [\,|\theta^l_j| \leq 1\,]\,\sum_{a,\,c:\;i(c) = j} w_c\,\bar h_l$",
    ),
    Row(
        "rounding",
        r"$\hat f = \mathrm{round}(f / q)\,q$",
        r"none: rounding is flat, and training uses Eq. (7)",
    ),
    Row(
        "likelihood",
        r"$b = -\log_2 p, \quad p = \Phi(z_+) - \Phi(z_-)$",
        r"$\overline{\tilde f} = \kappa\,(\varphi(z_+) - \varphi(z_-)) = -\bar\mu \qquad "
        r"\bar q = \kappa\,(\varphi(z_+) + \varphi(z_-))\,/\,2$",
    ),
    Row(
        "likelihood",
        r"$z_\pm = (\tilde f \pm q/2 - \mu)\,/\,\sigma$",
        r"$\bar\sigma = -\kappa\,(z_+ \varphi(z_+) - z_- \varphi(z_-)) \qquad "
        r"\kappa = -\bar b\,/\,(\sigma\,p \ln 2)$",
    ),
    Row(
        "prior",
        r"$(\mu, \log \sigma) = \psi_p(h), \quad -14 \leq \log \sigma \leq 6$",
        r"$\bar\psi_p = (\bar\mu,\; \sigma\,\bar\sigma)$, and 0 outside the limits",
    ),
    Row(
        "anchor_rate",
        r"$R_{anchor} = \sum_a\,(b_f + b_s + b_l + b_O)$",
        r"$\bar b_f = \bar b_s = \bar b_l = \bar b_O = \bar R_{anchor}$, and 0 for masked offsets",
    ),
    Row(
        "hash_rate",
        r"$R_{hash} = -N_+ \log_2 p_+ - N_- \log_2 p_-, \quad p_\pm = N_\pm\,/\,N$",
        r"$\bar\theta_j = [\,|\theta_j| \leq 1\,]\;\frac{1}{2} \log_2(N_- / N_+)\,\bar R_{hash}$",
    ),
    Row(
        "total_loss",
        r"$\mathcal{L}_{total} = \lambda_{rate}\,\mathcal{L}_{rate} + \mathcal{L}_{render}$",
        r"$\overline{\mathcal{L}}_{rate} = \lambda_{rate}\,\overline{\mathcal{L}}_{total} \qquad "
        r"\overline{\mathcal{L}}_{render} = \overline{\mathcal{L}}_{total}$",
    ),
    Row(
        "render_loss",
        r"$\mathcal{L}_{render} = (1 - \lambda)\,\mathrm{mean}\,|I - I^*| + \lambda\,(1 - SSIM)$",
        r"$\bar I = \overline{\mathcal{L}}_{render}\,"
        r"(\,(1 - \lambda)\,\mathrm{sign}(I - I^*)\,/\,n - \lambda\,\partial SSIM / \partial I\,)$",
    ),
    Row(
        "rate_loss",
        r"$\mathcal{L}_{rate} = (R_{anchor} + R_{hash})\,/\,n$",
        r"$\bar R_{anchor} = \bar R_{hash} = \overline{\mathcal{L}}_{rate}\,/\,n$",
    ),
    Row(
        "covariance",
        r"$\Sigma = M M^T, \quad M = R(r)\,\mathrm{diag}(s)$",
        r"$\bar M = (\bar\Sigma + \bar\Sigma^T)\,M \qquad "
        r"\bar s_j = \sum_i \bar M_{ij} R_{ij} \qquad \bar R_{ij} = \bar M_{ij}\,s_j$",
    ),
    Row(
        "projection",
        r"$\Sigma' = V \Sigma V^T + 0.3\,I, \quad V = J W$",
        r"$\bar\Sigma = V^T \bar\Sigma' V \qquad \bar V = (\bar\Sigma' + \bar\Sigma'^T)\,V \Sigma$",
    ),
    Row(
        "compositing",
        r"$C = \sum_i c_i\,\alpha_i\,T_i + T_N\,c_{bg}, \quad T_i = \prod_{j<i} (1 - \alpha_j)$",
        r"$\bar c_i = \alpha_i T_i\,\bar C \qquad "
        r"\bar\alpha_i = T_i\,(c_i - C_{>i}) \cdot \bar C$, $C_{>i}$ is the colour behind $i$",
    ),
)
TITLE = "P-4DGS: predictive 4D Gaussian splatting (arXiv:2510.10030)"
LEGEND = (
    r"A bar is the gradient of the loss, $\bar x = \partial\mathcal{L} / \partial x$. "
    r"Products are entry by entry; those with $W$, $M$, $V$ and $\Sigma$ are matrix products,"
    "\n"
    r"and $a \cdot b$ is a scalar product. $[\ldots]$ is 1 where true and 0 elsewhere. "
    r"$\Phi$ is the normal distribution, $\varphi$ its density; $n$ counts what is averaged."
)


UNDATED = dict.fromkeys(("Creator", "Producer", "CreationDate"))  # so that equal pages are equal


@figure_style(STYLE)
def draw_page():
    """Return the page as a figure."""
    figure = new_figure(figsize=PAGE, dpi=150)
    height = DRAWING * architecture.HEIGHT / architecture.WIDTH
    top = PAGE[1] - 0.62 - height
    axes = figure.add_axes(
        (MARGIN / PAGE[0], top / PAGE[1], DRAWING / PAGE[0], height / PAGE[1]),
    )
    architecture.paint(axes)
    for text in axes.texts:
        text.set_fontsize(max(SMALLEST, text.get_fontsize() * DRAWING / architecture.INCHES))
    write(figure, MARGIN, PAGE[1] - 0.45, TITLE, size=12, weight="bold")
    y = top - 0.4
    write(figure, MARGIN, y, LEGEND, size=8, linespacing=1.4)
    step = (y - 0.48) / len(ROWS)
    colors = {box.key: frame.color for frame in architecture.FRAMES for box in frame.boxes}
    for before, row in zip((None, *ROWS), ROWS):
        y -= step
        corner, size = (MARGIN / PAGE[0], (y - 0.09) / PAGE[1]), (0.05 / PAGE[0], step / PAGE[1])
        figure.add_artist(Rectangle(corner, *size, color=colors[row.key], linewidth=0))
        if before is None or row.key != before.key:
            number = architecture.number_of(row.key)
            write(figure, MARGIN + 0.13, y, number, weight="bold")
        write(figure, MARGIN + 0.5, y, row.formula)
        write(figure, MARGIN + 3.55, y, row.gradients)
    return figure


def write(figure, x, y, text, size=8.2, **style):
    """Write on the page; x and y in inches from its lower left corner."""
    figure.text(x / PAGE[0], y / PAGE[1], text, size=size, color=architecture.INK, **style)


@figure_style(STYLE)
def save(path):
    """Write the page as PDF, without a date and without matplotlib's version."""
    draw_page().savefig(path, metadata={"Title": TITLE, **UNDATED})
