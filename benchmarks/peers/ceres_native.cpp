// Ceres in C++: one cost function a view with hand-written derivatives, as an expert would.
// Transforms are a quaternion and a translation, moved by a twist from the left; the Jacobian by
// the twist stands in the first six of a transform's seven columns.

#include <ceres/ceres.h>

#include <Eigen/Dense>
#include <Eigen/Geometry>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using Matrix6d = Eigen::Matrix<double, 6, 6>;
using Row6d = Eigen::Matrix<double, 1, 6>;

struct Pose {
  Matrix3d R;
  Vector3d t;
  Pose operator*(const Pose& o) const { return {R * o.R, R * o.t + t}; }
};

Matrix3d cross(const Vector3d& v) {
  Matrix3d K;
  K << 0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0;
  return K;
}

Matrix6d adjoint(const Pose& p) {
  Matrix6d A = Matrix6d::Zero();
  A.topLeftCorner<3, 3>() = A.bottomRightCorner<3, 3>() = p.R;
  A.topRightCorner<3, 3>() = cross(p.t) * p.R;
  return A;
}

Pose unpack(const double* x) {
  return {Quaterniond(x[6], x[3], x[4], x[5]).toRotationMatrix(), Vector3d(x[0], x[1], x[2])};
}

class LeftTwist : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 7; }
  int TangentSize() const override { return 6; }
  bool Plus(const double* x, const double* d, double* out) const override {
    const Vector3d v(d[0], d[1], d[2]), w(d[3], d[4], d[5]);
    const double angle = w.norm();
    const Matrix3d K = cross(w);
    Matrix3d R = Matrix3d::Identity() + K + 0.5 * K * K, V = Matrix3d::Identity() + 0.5 * K;
    if (angle > 1e-9) {
      const double a = std::sin(angle) / angle, b = (1 - std::cos(angle)) / (angle * angle);
      R = Matrix3d::Identity() + a * K + b * K * K;
      V = Matrix3d::Identity() + b * K + (1 - a) / (angle * angle) * K * K;
    }
    const Pose p = unpack(x);
    const Vector3d t = R * p.t + V * v;
    const Quaterniond q(R * p.R);
    for (int k = 0; k < 3; ++k) out[k] = t[k];
    out[3] = q.x(), out[4] = q.y(), out[5] = q.z(), out[6] = q.w();
    return true;
  }
  bool PlusJacobian(const double*, double* J) const override {
    Eigen::Map<Eigen::Matrix<double, 7, 6, Eigen::RowMajor>> map(J);
    map.setZero();
    map.topRows<6>().setIdentity();
    return true;
  }
  bool Minus(const double*, const double*, double*) const override { return false; }
  bool MinusJacobian(const double*, double*) const override { return false; }
};

class View : public ceres::CostFunction {
 public:
  View(const double* points, const double* pixels, int n, const Pose& tool_from_base, double sigma,
       bool corrected)
      : points_(points), pixels_(pixels), n_(n), robot_(tool_from_base), inverse_(1 / sigma),
        corrected_(corrected) {
    set_num_residuals(2 * n);
    *mutable_parameter_block_sizes() = {5, 7, 7};
    if (corrected) mutable_parameter_block_sizes()->push_back(7);
  }

  bool Evaluate(double const* const* x, double* r, double** jacobians) const override {
    const double* c = x[0];
    const Pose hand = unpack(x[1]), world = unpack(x[2]);
    const Pose before = hand;
    const Pose tool = corrected_ ? unpack(x[3]) * robot_ : robot_;
    const Pose camera_from_base = hand * tool;
    const Pose pose = camera_from_base * world;
    const Matrix6d by_world = adjoint(camera_from_base), by_own = adjoint(before);
    for (int i = 0; i < n_; ++i) {
      const Vector3d p = pose.R * Vector3d(points_[3 * i], points_[3 * i + 1], points_[3 * i + 2]) + pose.t;
      const double rho = 1 / p[2], X = p[0] * rho, Y = p[1] * rho, s = X * X + Y * Y;
      const double ratio = 1 + c[4] * s;
      const double place[2] = {X * ratio, Y * ratio};
      for (int k = 0; k < 2; ++k)
        r[2 * i + k] = inverse_ * (pixels_[2 * i + k] - c[k] * place[k] - c[2 + k]);
      if (!jacobians) continue;
      const double mixed = 2 * c[4] * X * Y;
      const double along[2][2] = {{ratio + 2 * c[4] * X * X, mixed}, {mixed, ratio + 2 * c[4] * Y * Y}};
      for (int k = 0; k < 2; ++k) {
        const double f = -inverse_ * c[k], a = f * along[k][0], b = f * along[k][1];
        const double g = X * a + Y * b;
        Row6d twist;
        twist << rho * a, rho * b, -rho * g, -Y * g - b, a + X * g, X * b - Y * a;
        const int row = 2 * i + k;
        if (jacobians[0]) {
          double* J = jacobians[0] + 5 * row;
          J[0] = J[1] = J[2] = J[3] = 0;
          J[k] = -inverse_ * place[k];
          J[2 + k] = -inverse_;
          J[4] = f * (k ? Y : X) * s;
        }
        put(jacobians[1], row, twist);
        if (jacobians[2]) put(jacobians[2], row, twist * by_world);
        if (corrected_ && jacobians[3]) put(jacobians[3], row, twist * by_own);
      }
    }
    return true;
  }

 private:
  static void put(double* J, int row, const Row6d& values) {
    if (!J) return;
    for (int k = 0; k < 6; ++k) J[7 * row + k] = values[k];
    J[7 * row + 6] = 0;
  }
  const double *points_, *pixels_;
  int n_;
  Pose robot_;
  double inverse_;
  bool corrected_;
};

// log(correction) over its standard deviations.
class Prior : public ceres::SizedCostFunction<6, 7> {
 public:
  Prior(double translation, double rotation) : sigma_{translation, rotation} {}
  bool Evaluate(double const* const* x, double* r, double** jacobians) const override {
    const Pose p = unpack(x[0]);
    const Eigen::AngleAxisd turn(p.R);
    const Vector3d w = turn.angle() * turn.axis();
    const double angle = w.norm();
    const Matrix3d K = cross(w);
    // Small angles: the inverses of V and of the left Jacobian by their series.
    const double c = 1.0 / 12 + angle * angle / 720;
    const Vector3d v = (Matrix3d::Identity() - 0.5 * K + c * K * K) * p.t;
    for (int k = 0; k < 3; ++k) r[k] = v[k] / sigma_[0], r[3 + k] = w[k] / sigma_[1];
    if (jacobians && jacobians[0]) {
      Matrix6d ad = Matrix6d::Zero();
      ad.topLeftCorner<3, 3>() = ad.bottomRightCorner<3, 3>() = K;
      ad.topRightCorner<3, 3>() = cross(v);
      Matrix6d J = Matrix6d::Identity() - 0.5 * ad + ad * ad / 12;
      J.topRows<3>() /= sigma_[0];
      J.bottomRows<3>() /= sigma_[1];
      for (int i = 0; i < 6; ++i) {
        for (int k = 0; k < 6; ++k) jacobians[0][7 * i + k] = J(i, k);
        jacobians[0][7 * i + 6] = 0;
      }
    }
    return true;
  }

 private:
  double sigma_[2];
};

Pose matrix(const double* m) {
  Pose p;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) p.R(i, j) = m[4 * i + j];
    p.t[i] = m[4 * i + 3];
  }
  return p;
}

std::vector<double> packed(const Pose& p) {
  const Quaterniond q(p.R);
  return {p.t[0], p.t[1], p.t[2], q.x(), q.y(), q.z(), q.w()};
}

// Of this program alone; getrusage also counts what the process was before it.
static double PeakMegabytes() {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmHWM:", 0) == 0) return std::stod(line.substr(6)) / 1024.0;
  return 0.0;
}

int main(int, char** argv) {
  const auto began = std::chrono::steady_clock::now();
  std::ifstream file(argv[1], std::ios::binary | std::ios::ate);
  std::vector<double> data(file.tellg() / sizeof(double));
  file.seekg(0);
  file.read(reinterpret_cast<char*>(data.data()), data.size() * sizeof(double));
  const int views = data[0], n = data[1], repeats = std::atoi(argv[2]), threads = std::atoi(argv[3]);
  const bool corrected = data[2] != 0;
  const double* points = data.data() + 6;
  const double* pixels = points + 3 * n;
  const double* robots = pixels + 2l * views * n;
  const double* start = robots + 12 * views;

  std::vector<double> seconds;
  double cold = 0, cost = 0;
  int steps = 0;
  for (int repeat = 0; repeat <= repeats; ++repeat) {
    const auto first = std::chrono::steady_clock::now();
    std::vector<double> camera(start, start + 5);
    std::vector<double> hand = packed(matrix(start + 5)), world = packed(matrix(start + 17));
    std::vector<std::vector<double>> own(corrected ? views : 0, {0, 0, 0, 0, 0, 0, 1});
    ceres::Problem problem;
    for (int k = 0; k < views; ++k) {
      std::vector<double*> blocks = {camera.data(), hand.data(), world.data()};
      if (corrected) blocks.push_back(own[k].data());
      problem.AddResidualBlock(
          new View(points, pixels + 2l * n * k, n, matrix(robots + 12 * k), data[5], corrected),
          nullptr, blocks);
      if (corrected) problem.AddResidualBlock(new Prior(data[3], data[4]), nullptr, own[k].data());
    }
    problem.SetManifold(hand.data(), new LeftTwist);
    problem.SetManifold(world.data(), new LeftTwist);
    for (auto& c : own) problem.SetManifold(c.data(), new LeftTwist);
    ceres::Solver::Options options;
    options.linear_solver_type = corrected ? ceres::DENSE_SCHUR : ceres::DENSE_NORMAL_CHOLESKY;
    if (corrected) {
      auto* order = new ceres::ParameterBlockOrdering;
      for (auto& c : own) order->AddElementToGroup(c.data(), 0);
      for (double* b : {camera.data(), hand.data(), world.data()}) order->AddElementToGroup(b, 1);
      options.linear_solver_ordering.reset(order);
    }
    options.num_threads = threads;
    options.function_tolerance = 1e-12;
    options.parameter_tolerance = options.gradient_tolerance = 1e-14;
    options.logging_type = ceres::SILENT;
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem, &summary);
    const auto now = std::chrono::steady_clock::now();
    if (repeat == 0) cold = std::chrono::duration<double>(now - began).count();
    else seconds.push_back(std::chrono::duration<double>(now - first).count());
    cost = summary.final_cost;
    steps = summary.num_successful_steps + summary.num_unsuccessful_steps;
  }
  std::printf("{\"seconds\": [");
  for (size_t k = 0; k < seconds.size(); ++k) std::printf(k ? ", %.6f" : "%.6f", seconds[k]);
  std::printf("], \"cost\": %.15g, \"iterations\": %d, \"cold\": %.4f, \"peak_mb\": %.1f}\n", cost,
              steps, cold, PeakMegabytes());
}
