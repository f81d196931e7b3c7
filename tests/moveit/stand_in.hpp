// Stand-ins for the headers of MoveIt, ROS and Eigen, which are not to be had here: declarations with the names and
// signatures that kinematics_plugin.cpp uses, and a model that is read from a file. They prove its syntax and what it
// does, not that it fits MoveIt's binary interface. STAND_IN_MOVEIT is 1 or 2.
#pragma once
#include <cmath>
#include <cstdio>
#include <functional>
#include <istream>
#include <map>
#include <memory>
#include <string>
#include <vector>

#if STAND_IN_MOVEIT == 2
#define MESSAGES(package) package::msg
#else
#define MESSAGES(package) package
#endif

namespace MESSAGES(geometry_msgs)
{
struct Point
{
  double x = 0, y = 0, z = 0;
};
struct Quaternion
{
  double x = 0, y = 0, z = 0, w = 1;
};
struct Pose
{
  Point position;
  Quaternion orientation;
};
}
namespace MESSAGES(moveit_msgs)
{
struct MoveItErrorCodes
{
  enum
  {
    SUCCESS = 1,
    NO_IK_SOLUTION = -31
  };
  int val = 0;
};
}

#if STAND_IN_MOVEIT == 2
namespace rclcpp
{
struct Node
{
  using SharedPtr = std::shared_ptr<Node>;
};
inline std::string get_logger(const std::string& name)
{
  return name;
}
}  // namespace rclcpp
#define RCLCPP_ERROR(logger, format, text) std::fprintf(stderr, "%s: " format "\n", (logger).c_str(), text)
#else
#define ROS_ERROR_NAMED(name, format, text) std::fprintf(stderr, "%s: " format "\n", name, text)
#endif

namespace Eigen
{
struct Isometry3d
{
  double m[3][4] = { { 1, 0, 0, 0 }, { 0, 1, 0, 0 }, { 0, 0, 1, 0 } };
  double operator()(int row, int column) const
  {
    return m[row][column];
  }
  Isometry3d operator*(const Isometry3d& other) const
  {
    Isometry3d result;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 4; ++j)
      {
        result.m[i][j] = j == 3 ? m[i][3] : 0.0;
        for (int k = 0; k < 3; ++k)
          result.m[i][j] += m[i][k] * other.m[k][j];
      }
    return result;
  }
  Isometry3d inverse() const
  {
    Isometry3d result;
    for (int i = 0; i < 3; ++i)
    {
      result.m[i][3] = 0.0;
      for (int k = 0; k < 3; ++k)
      {
        result.m[i][k] = m[k][i];
        result.m[i][3] -= m[k][i] * m[k][3];
      }
    }
    return result;
  }
};
}  // namespace Eigen

namespace moveit
{
namespace core
{
struct Joint
{
  std::string name, child;
  Eigen::Isometry3d origin;
  bool is_revolute;
};
struct JointModelGroup
{
  std::vector<std::string> joints;
  const std::vector<std::string>& getActiveJointModelNames() const
  {
    return joints;
  }
};
// A chain from the link "base_link".
struct RobotModel : std::enable_shared_from_this<RobotModel>
{
  std::vector<Joint> chain;
  JointModelGroup group;
  explicit RobotModel(std::istream& file)
  {
    Joint joint;
    while (file >> joint.name >> joint.child >> joint.is_revolute)
    {
      for (auto& row : joint.origin.m)
        for (double& value : row)
          file >> value;
      chain.push_back(joint);
      if (joint.is_revolute)
        group.joints.push_back(joint.name);
    }
  }
  const JointModelGroup* getJointModelGroup(const std::string& name) const
  {
    return name == "manipulator" ? &group : nullptr;
  }
  bool hasLinkModel(const std::string& name) const
  {
    for (const Joint& joint : chain)
      if (joint.child == name)
        return true;
    return name == "base_link";
  }
};
using RobotModelConstPtr = std::shared_ptr<const RobotModel>;
class RobotState
{
public:
  explicit RobotState(const RobotModelConstPtr& model) : model_(model)
  {
  }
  void setToDefaultValues()
  {
    q_.assign(model_->group.joints.size(), 0.0);
    update();
  }
  void setJointGroupPositions(const JointModelGroup*, const std::vector<double>& q)
  {
    q_ = q;
    update();
  }
  const Eigen::Isometry3d& getGlobalLinkTransform(const std::string& link)
  {
    return frames_.at(link);
  }

private:
  void update()
  {
    Eigen::Isometry3d frame;
    std::size_t number = 0;
    frames_["base_link"] = frame;
    for (const Joint& joint : model_->chain)
    {
      frame = frame * joint.origin;
      if (joint.is_revolute)
      {
        const double s = std::sin(q_[number]), c = std::cos(q_[number]);
        ++number;
        frame = frame * Eigen::Isometry3d{ { { c, -s, 0, 0 }, { s, c, 0, 0 }, { 0, 0, 1, 0 } } };
      }
      frames_[joint.child] = frame;
    }
  }
  RobotModelConstPtr model_;
  std::vector<double> q_;
  std::map<std::string, Eigen::Isometry3d> frames_;
};
}  // namespace core
}  // namespace moveit

namespace kinematics
{
namespace DiscretizationMethods
{
enum DiscretizationMethod
{
  NO_DISCRETIZATION = 1,
  ALL_DISCRETIZED
};
}
namespace KinematicErrors
{
enum KinematicError
{
  OK = 1,
  UNSUPORTED_DISCRETIZATION_REQUESTED,
  DISCRETIZATION_NOT_INITIALIZED,
  MULTIPLE_TIPS_NOT_SUPPORTED,
  EMPTY_TIP_POSES,
  IK_SEED_OUTSIDE_LIMITS,
  SOLVER_NOT_ACTIVE,
  NO_SOLUTION
};
}
struct KinematicsQueryOptions
{
  bool lock_redundant_joints = false;
  bool return_approximate_solution = false;
  DiscretizationMethods::DiscretizationMethod discretization_method = DiscretizationMethods::NO_DISCRETIZATION;
};
struct KinematicsResult
{
  KinematicErrors::KinematicError kinematic_error;
  double solution_percentage;
};

class KinematicsBase
{
public:
  using Pose = MESSAGES(geometry_msgs)::Pose;
  using ErrorCodes = MESSAGES(moveit_msgs)::MoveItErrorCodes;
  using Values = std::vector<double>;
  using Options = KinematicsQueryOptions;
  using IKCallbackFn = std::function<void(const Pose&, const Values&, ErrorCodes&)>;

  virtual ~KinematicsBase() = default;
  virtual bool getPositionIK(const Pose&, const Values&, Values&, ErrorCodes&, const Options& = Options()) const = 0;
  virtual bool getPositionIK(const std::vector<Pose>&, const Values&, std::vector<Values>&, KinematicsResult&,
                             const Options&) const = 0;
  virtual bool searchPositionIK(const Pose&, const Values&, double, Values&, ErrorCodes&,
                                const Options& = Options()) const = 0;
  virtual bool searchPositionIK(const Pose&, const Values&, double, const Values&, Values&, ErrorCodes&,
                                const Options& = Options()) const = 0;
  virtual bool searchPositionIK(const Pose&, const Values&, double, Values&, const IKCallbackFn&, ErrorCodes&,
                                const Options& = Options()) const = 0;
  virtual bool searchPositionIK(const Pose&, const Values&, double, const Values&, Values&, const IKCallbackFn&,
                                ErrorCodes&, const Options& = Options()) const = 0;
  virtual bool searchPositionIK(const std::vector<Pose>& poses, const Values& seed, double timeout,
                                const Values& consistency_limits, Values& solution, const IKCallbackFn& callback,
                                ErrorCodes& error, const Options& options = Options(),
                                const moveit::core::RobotState* = nullptr) const
  {
    return searchPositionIK(poses.at(0), seed, timeout, consistency_limits, solution, callback, error, options);
  }
  virtual bool getPositionFK(const std::vector<std::string>&, const Values&, std::vector<Pose>&) const = 0;
  virtual const std::vector<std::string>& getJointNames() const = 0;
  virtual const std::vector<std::string>& getLinkNames() const = 0;
#if STAND_IN_MOVEIT == 2
  virtual bool initialize(const rclcpp::Node::SharedPtr&, const moveit::core::RobotModel&, const std::string&,
                          const std::string&, const std::vector<std::string>&, double)
#else
  virtual bool initialize(const moveit::core::RobotModel&, const std::string&, const std::string&,
                          const std::vector<std::string>&, double)
#endif
  {
    return false;
  }

protected:
  void storeValues(const moveit::core::RobotModel& model, const std::string& group, const std::string& base,
                   const std::vector<std::string>& tips, double)
  {
    robot_model_ = model.shared_from_this();
    group_name_ = group;
    base_frame_ = base;
    tip_frames_ = tips;
  }
#if STAND_IN_MOVEIT == 2
  rclcpp::Node::SharedPtr node_;
#endif
  moveit::core::RobotModelConstPtr robot_model_;
  std::string group_name_, base_frame_;
  std::vector<std::string> tip_frames_;
};
}  // namespace kinematics

// pluginlib: one class of a program, made by name.
inline std::function<std::unique_ptr<kinematics::KinematicsBase>()> make_exported;
#define PLUGINLIB_EXPORT_CLASS(type, base)                                                                             \
  static const bool is_exported = (make_exported = [] { return std::unique_ptr<base>(new type); }, true);
