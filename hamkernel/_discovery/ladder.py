"""The ladder of structures and symmetries for `compare`.

With one kernel type per step, the first comparison took 96 s, of which JAX compiled 15 searches for
90 s. A `Rung` is a kernel for any step of the ladder: its arrays choose between structures and
symmetries. One compiled search then serves all steps with the same numbers of parts and images.
There are three such searches.
"""

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel._kernels.base import AbstractScalarKernel, Bounds, Invariance, bounds_of_length
from hamkernel._kernels.built_in import Gaussian
from hamkernel._kernels.symmetry import LinearMap
from hamkernel._kernels.transforms import Select
from hamkernel._structures.base import AbstractMatrixKernel, Odd, Reversible, total
from hamkernel._structures.friction import PortHamiltonian
from hamkernel._structures.structure import (
    CurlFree,
    DivergenceFree,
    Separable,
    Symplectic,
    canonical,
)

NO_FRICTION = -200.0  # the logarithm of zero friction: e⁻²⁰⁰ vanishes in every sum


class Rung(AbstractMatrixKernel):
    """The kernel Σᵢ Σ_g w_ig K_ig(x, z) of a step, with a structure chosen by numbers.

    Each part i depends on some of the coordinates, and each image g changes signs. With
    k = aᵢ exp(−‖(x − gz)/ℓ‖²/2) and M = ∂x ∂zᵀ k,

        K_ig = s k I + d (tr(M) I − Mᵀ) + B M Bᵀ,    B = c I + h (J − R).

    Attributes:
        log_variances: the log variance of a component of the field, for each part. The variance of
            a potential is ℓ² times as large, with the geometric mean ℓ of the part's lengthscales.
        log_lengthscales: log ℓ for each coordinate.
        log_friction: the logarithm of the diagonal of R on the momenta.
        masks: 1 if the part depends on the coordinate, else 0.
        weights: the w_ig, which we divide by Σ_g |w_ig|.
        structure: (s, d, c, h), one of which is 1 and the others 0.
    """

    log_variances: Float[Array, " parts"]
    log_lengthscales: Float[Array, " n"]
    log_friction: Float[Array, ""]
    masks: Int[Array, "parts n"]
    weights: Int[Array, "parts images"]
    structure: Int[Array, " 4"]

    symplectic: ClassVar[bool] = False
    differentiated_backward: ClassVar[bool] = True
    no_potential: ClassVar[str | None] = "a Rung is only searched: ask the kernel of its Step."

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return u @ self.blocks(x[None], z[None])[0, :, 0] @ v

    def blocks(self, X: Float[Array, "N n"], Z: Float[Array, "M n"]) -> Float[Array, "N n M n"]:
        n, dtype = X.shape[1], X.dtype
        numbers = (self.masks, self.weights, self.structure)
        masks, weights, (s, d, c, h) = (numbers_array.astype(dtype) for numbers_array in numbers)
        weights = weights / jnp.abs(weights).sum(axis=1, keepdims=True)
        weights = (weights * self.amplitudes().astype(dtype)[:, None]).reshape(-1)
        parts, images = self.weights.shape
        D = jnp.repeat(masks * jnp.exp(-2 * self.log_lengthscales).astype(dtype)[None], images, 0)
        S = jnp.tile(jnp.asarray(_signs(n, images), dtype), (parts, 1))
        one = jnp.eye(n, dtype=dtype)
        B = c * one + h * self._hamiltonian_operator(n).astype(dtype)
        # Let k = w exp(−½(x − Sz)ᵀD(x − Sz)) with D and S diagonal, and a = D(x − Sz). Then
        # ∂x k = −k a, ∂z k = k Sa, ∂x_i a_j = D_ij and ∂z_j a_i = −(DS)_ij, so
        #     M = ∂x ∂zᵀ k = k (DS − a(Sa)ᵀ),     B M Bᵀ = k (B DS Bᵀ − (Ba)(BSa)ᵀ),
        #     tr(M) I − Mᵀ = k ((tr DS − a·Sa) I − DS + (Sa)aᵀ).
        # C = s I + B DS Bᵀ + d (tr(DS) I − DS) is the same for all pairs. No step has d = 1 for
        # n ≤ 2.
        C = s * one[None] + jnp.einsum("ac,tc,bc->tab", B, D * S, B)
        if n > 2:
            C = C + d * ((D * S).sum(axis=1)[:, None, None] - (D * S)[..., None]) * one[None]

        # The barrier makes XLA compute the components of Ba and BSa, arrays (N, M), only once.
        # Fused into each entry of the blocks, they took eight times as long.
        @jax.checkpoint
        def term(w, D, S, C):
            differences = [x[:, None] - z[None] for x, z in zip(X.T, S[:, None] * Z.T, strict=True)]
            k = w * jnp.exp(-0.5 * total([D[i] * differences[i] ** 2 for i in range(n)]))
            a = [D[i] * differences[i] for i in range(n)]
            Sa = [S[i] * a[i] for i in range(n)]
            Ba, BSa = (
                [total([B[i, j] * a[j] for j in range(n)]) for i in range(n)] for a in (a, Sa)
            )
            k, Ba, BSa = jax.lax.optimization_barrier((k, Ba, BSa))

            def entry(i, j):
                block = C[i, j] - Ba[i] * BSa[j]
                if n > 2:
                    block = block + d * Sa[i] * a[j]
                    if i == j:
                        block = block - d * total([a * b for a, b in zip(a, Sa, strict=True)])
                return k * block

            return [[entry(i, j) for j in range(n)] for i in range(n)]

        def add(sums, one_term):
            return jax.tree.map(jnp.add, sums, term(*one_term)), None

        nothing = [[jnp.zeros((len(X), len(Z)), dtype)] * n] * n
        sums_of_entries, _ = jax.lax.scan(add, nothing, (weights, D, S, C))
        return jnp.stack([jnp.stack(row, axis=-1) for row in sums_of_entries], axis=1)

    def _hamiltonian_operator(self, n: int) -> Float[Array, "n n"]:
        """The operator J − R; zero if n is odd."""
        m, odd = divmod(n, 2)
        if odd:
            return jnp.zeros((n, n), self.log_friction.dtype)
        one = jnp.eye(n, dtype=self.log_friction.dtype)
        return canonical(one) - jnp.exp(self.log_friction) * one.at[:m].set(0)

    def amplitudes(self) -> Float[Array, " parts"]:
        """The amplitudes aᵢ of the parts."""
        masks = self.masks.astype(self.log_lengthscales.dtype)
        squares = 2 * (masks @ self.log_lengthscales) / masks.sum(axis=1)
        of_fields = self.structure[0] > 0
        return jnp.exp(self.log_variances + jnp.where(of_fields, jnp.zeros_like(squares), squares))

    def expansion(self, x: Array, Z: Array, A: Array) -> Float[Array, " n"]:
        return jnp.einsum("jab,jb->a", jax.vmap(lambda z: self(x, z))(Z), A)

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        value = np.asarray(getattr(self, name))
        if name == "log_lengthscales":
            return bounds_of_length(value, X, 0.3, 30.0)
        if name == "log_variances":
            return np.log(1e-5 * amplitude), np.log(1e5 * amplitude)
        if value == NO_FRICTION:
            return value, value
        return PortHamiltonian(Gaussian(1.0)).bounds(name, X, amplitude)

    def shares_potential(self, kernel: AbstractMatrixKernel) -> bool:
        return False

    def with_parity(self, parity: int) -> AbstractMatrixKernel:
        raise TypeError(self.no_potential)

    def average_over(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError(self.no_potential)

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return ()

    @property
    def invariance(self) -> Invariance:
        return Invariance.NONE


def _signs(n: int, images: int) -> Float[np.ndarray, "images n"]:
    """The signs of the images x, −x and, if there are four, (q, −p) and (−q, p) (time reversal)."""
    reversal = np.repeat([1.0, -1.0], [n // 2, n - n // 2])
    return np.stack([np.ones(n), -np.ones(n), reversal, -reversal])[:images]


class LadderStep(NamedTuple):
    """One step of the ladder.

    Attributes:
        structure: the class of the kernel; `Symplectic` with friction means `PortHamiltonian`.
        apart: whether H = T(p) + U(q).
        friction: whether there is friction on the momenta.
        mirror: whether f(−x) = −f(x).
        reversible: whether H(q, −p) = H(q, p).
    """

    structure: type[AbstractMatrixKernel]
    apart: bool = False
    friction: bool = False
    mirror: bool = False
    reversible: bool = False

    @property
    def claims(self) -> frozenset[str]:
        """The questions to which the answer is yes for all fields, as in `compare.claims`."""
        answers = {"mirror"} if self.mirror else set()
        if self.structure is Symplectic:
            answers.add("energy")
            # T(p) + U(q) with a mirror has an even T.
            back = self.reversible or (self.apart and self.mirror)
            answers |= {"friction"} if self.friction else {"reversible"} if back else set()
            answers |= {"T + U"} if self.apart else set()
        return frozenset(answers)

    def rung(self, scale: Float[np.ndarray, " n"], speed: float) -> Rung:
        """The kernel of the step, with lengthscales 2 `scale` and fields of size `speed`.

        Args:
            scale: the standard deviation of each coordinate; 0 counts as 1.
            speed: the root mean square of a component of the field.
        """
        n = len(scale)
        momenta = np.repeat([0, 1], [n // 2, n - n // 2])
        even = int(self.mirror) * (-1 if self.structure is Separable else 1)
        if self.apart:  # T(p) and U(q); for T, time reversal is the mirror image
            masks = [momenta, 1 - momenta]
            weights = [[1, self.mirror or self.reversible], [1, even]]
        else:
            masks = [momenta * 0 + 1]
            weights = [[1, even, 1, even] if self.reversible else [1, even]]
        length = np.log(2 * np.where(scale > 0, scale, 1.0))
        structures = Separable, DivergenceFree, CurlFree, Symplectic
        return Rung(
            log_variances=jnp.asarray(np.full(len(masks), 2 * np.log(speed))),
            log_lengthscales=jnp.asarray(length),
            log_friction=jnp.asarray(np.float64(np.log(0.1) if self.friction else NO_FRICTION)),
            masks=jnp.asarray(np.array(masks)),
            weights=jnp.asarray(np.array(weights, int)),
            structure=jnp.asarray([int(self.structure is structure) for structure in structures]),
        )

    def kernel(self, rung: Rung) -> AbstractMatrixKernel:
        """The structured kernel with the hyperparameters of the rung."""
        n, length = len(rung.log_lengthscales), jnp.exp(rung.log_lengthscales)
        terms = []
        for mask, amplitude in zip(np.asarray(rung.masks), rung.amplitudes(), strict=True):
            dims = tuple(np.flatnonzero(mask).tolist())
            k = Gaussian(length[np.array(dims)])
            terms.append(amplitude * (k if len(dims) == n else Select(k, dims)))
        k = sum(terms[1:], start=terms[0])
        friction = jnp.exp(rung.log_friction)
        K = PortHamiltonian(k, friction) if self.friction else self.structure(k)  # type: ignore[call-arg]
        K = Odd(K) if self.mirror else K
        return Reversible(K) if self.reversible else K


def ladder(n: int) -> dict[str, LadderStep]:
    """The steps by name, the weakest structure first, in all combinations."""
    steps = {"any field": LadderStep(Separable), "gradient": LadderStep(CurlFree)}
    if n > 2:
        steps["divergence-free"] = LadderStep(DivergenceFree)
    if n % 2 == 0:
        steps |= {
            "energy": LadderStep(Symplectic),
            "energy, friction": LadderStep(Symplectic, friction=True),
            "T + U": LadderStep(Symplectic, apart=True),
            "T + U, friction": LadderStep(Symplectic, apart=True, friction=True),
        }
    steps |= {f"{name}, mirror": step._replace(mirror=True) for name, step in steps.items()}
    if n % 2 == 0:  # T + U with a mirror has an even T, and is reversible
        for name in ("energy", "energy, mirror", "T + U"):
            steps[f"{name}, reversible"] = steps[name]._replace(reversible=True)
    return steps
